"""True positions of a session: how good its answers were (`truths`), and what the next map learns (`experience`)."""

import re

import numpy as np
import pytest

from deepsimbad.engine.maps import load_snapshot
from deepsimbad.errors import UnavailableError

from .conftest import JSON, N_LANDMARKS, N_READY, path_of, problem, ready_encodings

STEP_M = 4.0
NO_RANKS = {"retrieval_ranks": None, "map_version": 1}
ANEW = {"training_traverse": "drive", "landmark_traverse": "drive"}


class Walk:
    """A session that drives along the map itself, two images a view.

    Attributes:
        positions_m: Where it was.
        shares: The rank share of the truth in the belief after every view.
        retrievals: The relevance of every map image, by view.
    """

    def __init__(self, client, domain, n_views=5):
        self._client, self._domain = client, domain
        session = client.begin(domain)
        self.session_id, self.path = session["session_id"], path_of(session)
        self.positions_m = [STEP_M * view for view in range(n_views)]
        self.shares = []
        self.retrievals = []
        for view in range(n_views):
            encoding = (ready_encodings()[2 * view] + 0.8).tolist()
            document = client.observe(self.path, {"encoding": encoding}, action_m=STEP_M, shortlist=N_READY)
            self.retrievals.append({place["map_image"]: place["relevance"] for place in document["retrieval"]})
            mass = {place["map_image"]: place["mass"] for place in document["belief"]["top"]}
            self.shares.append(rank(mass, [2 * view]) / N_READY)

    def post_truths(self, positions_m, **options):
        body = {"true_positions_m": positions_m, **options}
        return self._client.answer_to("POST", f"{self.path}/truths", json=body)

    def metric(self):
        """The live ANR metric of the domain: the number of observations, and the sum of their ranks in percent."""
        pattern = rf'^deepsimbad_live_anr_percent_(count|sum)\{{domain="{self._domain}"\}} (\S+)$'
        values = dict(re.findall(pattern, self._client.get("/metrics").text, re.MULTILINE))
        return int(float(values.get("count", 0))), float(values.get("sum", 0))

    def learn(self, positions_m=None, domain=None):
        body = {"session_id": self.session_id, "true_positions_m": positions_m or self.positions_m}
        return self._client.post(f"/v1/admin/domains/{domain or self._domain}/experience", json=body)


def rank(scores, true_images):
    """The number of images with higher scores than the best true one, and half of those tied with it."""
    best = max(scores[image] for image in true_images)
    return sum(score > best for score in scores.values()) + (list(scores.values()).count(best) - 1) / 2


def test_the_answer_is_the_anr_of_the_beliefs_that_were_answered(client, domain):
    walk = Walk(client, domain)
    assert len(set(walk.shares)) > 1, "else nothing is shown"
    shares = walk.shares
    expected = pytest.approx(100 * float(np.mean(shares)))
    assert walk.post_truths(walk.positions_m) == {"n_scored": 5, "n_left_out": 0, "anr": expected, **NO_RANKS}
    assert walk.metric() == (5, pytest.approx(100 * sum(shares)))
    part = walk.post_truths([None, *walk.positions_m[1:3], None, None])
    assert part == {"n_scored": 2, "n_left_out": 3, "anr": pytest.approx(50 * sum(shares[1:3])), **NO_RANKS}
    assert walk.post_truths([None] * 5) == {"n_scored": 0, "n_left_out": 5, "anr": None, **NO_RANKS}


def test_each_view_is_ranked_by_the_map_images_told(client, domain):
    """Ranks follow ANR's rule, in pieces or all at once, also after the session went on or ended."""
    walk = Walk(client, domain, 6)
    images = [[2 * view, 2 * view + 1] if view != 1 else [] for view in range(6)]
    expected = [rank(walk.retrievals[view], images[view]) if images[view] else None for view in range(6)]
    assert len(set(expected)) > 2, "else nothing is shown"

    def ranks(first, last):
        unknown = [None] * (last - first)
        answer = walk.post_truths(unknown, true_map_images=images[first:last], first_observation=first)
        assert answer["n_left_out"] == last - first
        return answer["retrieval_ranks"]

    assert ranks(0, 6) == expected
    assert ranks(3, 6) == expected[3:]
    client.put(f"{walk.path}/prior", json={"position_m": 3.0, "std_m": 1.0})
    answer = client.observe(walk.path, {"encoding": ready_encodings()[12].tolist()})
    assert answer["retrieval"][0]["map_image"] == 12
    images.append([12])
    assert ranks(6, 7) == [0]
    client.delete(walk.path)
    assert ranks(2, 7) == [*expected[2:], 0]
    assert walk.metric()[0] == 0, "the alarm is of positions alone"


def test_a_truth_far_from_the_map_says_nothing_of_it(client, domain):
    walk = Walk(client, domain, 3)
    last_m = 2.0 * (N_READY - 1)
    answer = walk.post_truths([walk.positions_m[0], 1e9, last_m + 10.5])
    assert answer == {"n_scored": 1, "n_left_out": 2, "anr": pytest.approx(100 * walk.shares[0]), **NO_RANKS}
    assert walk.metric()[0] == 1
    assert walk.post_truths([None, None, last_m + 9.5])["n_scored"] == 1


def test_an_observation_is_counted_once_whoever_tells(client, domain, monkeypatch):
    walk = Walk(client, domain)
    for _ in range(2):
        walk.post_truths([*walk.positions_m[:3], None, None])
        assert walk.metric() == (3, pytest.approx(100 * sum(walk.shares[:3])))
    for positions_m in (walk.positions_m, [None] * 5, walk.positions_m):
        walk.post_truths(positions_m)
        assert walk.metric() == (5, pytest.approx(100 * sum(walk.shares)))
    client.post(f"{walk.path}/observations", json={"ranked_landmarks": [1]})
    walk.post_truths([*walk.positions_m, 16.0])
    assert walk.metric()[0] == 6
    assert client.get(walk.path).json()["n_observations"] == 6, "telling moves nothing"

    def refuse(*_):
        raise UnavailableError("no job is taken now")

    walk = Walk(client, domain)
    with monkeypatch.context() as patch:
        patch.setattr(client.services.runner, "submit", refuse)
        problem(walk.learn(), 503, "unavailable")
    client.delete(walk.path)
    jobs = [walk.learn().json() for _ in range(2)]
    walk.post_truths(walk.positions_m)
    assert walk.metric()[0] == 11
    assert [client.wait_for(job["job_id"])["state"] for job in jobs] == ["succeeded"] * 2


def test_a_deleted_domain_takes_its_series_along(client, domain):
    walk = Walk(client, domain)
    walk.post_truths(walk.positions_m)
    assert f'domain="{domain}"' in client.get("/metrics").text
    assert client.delete(f"/v1/admin/domains/{domain}").status_code == 204
    assert f'domain="{domain}"' not in client.get("/metrics").text
    answer = client.post(f"{walk.path}/truths", json={"true_positions_m": walk.positions_m})
    problem(answer, 410, "retired_map")
    client.services.metrics.record_localization(domain, {"plan": 1.0}, 2.0)  # a view that was on its way
    assert f'domain="{domain}"' not in client.get("/metrics").text


def test_truths_that_cannot_be(client):
    walk = Walk(client, "ready", 2)
    images = '[null, null], "true_map_images": '
    for code, values in {
        "invalid_input": [
            *("[1, 2, 3]", "[1]", "[1, NaN]", "[1, 1e999]", images + "[[1]]", images + "[[1], [1000]]"),
            '[1, 2], "first_observation": 1000000000000',
        ],
        "invalid_request": [
            *("[]", '["1", 2]', "[true, 2]", "null", '[1, 2], "more": 1'),
            *(images + "[[1], [-1]]", images + "[[1], [99999999999999999999]]"),
        ],
    }.items():
        for value in values:
            body = f'{{"true_positions_m": {value}}}'
            problem(client.post(f"{walk.path}/truths", content=body, headers=JSON), 422, code)
    answer = client.post(f"{walk.path}/truths", content="x", headers={"Content-Type": "text/plain"})
    problem(answer, 415, "unsupported_media_type")
    assert walk.metric()[0] == 0


# Experience


def test_the_next_map_learns_from_a_session(client, domain):
    walk = Walk(client, domain, 6)
    positions_m = [*walk.positions_m]
    positions_m[3] = None
    answer = walk.learn(positions_m)
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"].endswith(answer.json()["job_id"])
    job = client.wait_for(answer.json()["job_id"])
    assert (job["state"], job["kind"], job["result"]["map_version"]) == ("succeeded", "experience", 2)
    assert job["result"]["metrics"]["experience"] == {"from_version": 1, "n_walks": 1, "n_moves": 4}
    old_q_values, new_q_values = (
        load_snapshot(client.services.catalog, domain, version).q_values for version in (1, 2)
    )
    assert old_q_values is not None
    step = np.ptp(new_q_values) / 65535  # of numbers packed into two bytes, which is another where their range is
    actions = np.flatnonzero((np.abs(old_q_values - new_q_values) > 2 * step).any(axis=0))
    assert actions.tolist() == [3]  # the move of 4 m alone
    assert client.get(walk.path).json()["map_version"] == 1
    # A session on the older version may be fed back too: its landmarks are the same. A prior begins another walk.
    client.put(f"{walk.path}/prior", json={"position_m": 8, "std_m": 1})
    for _ in range(2):
        client.observe(walk.path, {"ranked_landmarks": [1, 2, 3]})
    client.delete(walk.path)  # and an ended one as well
    result = client.wait_for(walk.learn([*walk.positions_m, 8.0, 8.0]).json()["job_id"])["result"]
    assert (result["map_version"], result["metrics"]["experience"]["n_walks"]) == (3, 2)


def test_a_session_whose_map_is_gone_or_differs(client, domain, data_dir):
    walk = Walk(client, domain, 3)
    maps = f"/v1/admin/domains/{domain}/maps"
    client.remap(domain, **ANEW, n_landmarks=N_LANDMARKS - 1)
    answer = walk.post_truths(walk.positions_m)  # the season has turned, the session's own map still tells
    assert (answer["map_version"], answer["anr"]) == (1, pytest.approx(100 * float(np.mean(walk.shares))))
    problem(walk.learn(), 409, "conflict")
    client.remap(domain, **ANEW, n_landmarks=N_LANDMARKS)
    file = data_dir / "domains" / domain / "maps" / "000001.sqlite"
    file.rename(file.with_suffix(".aside"))
    client.services.maps.forget(domain)
    assert ".sqlite" not in str(problem(walk.learn(), 503, "damaged_map"))
    file.with_suffix(".aside").rename(file)
    client.delete(walk.path)
    assert client.delete(f"{maps}/1").status_code == 204
    problem(walk.learn(), 410, "retired_map")
    walk = Walk(client, domain, 3)
    assert client.delete(f"/v1/admin/domains/{domain}").status_code == 204
    client.make_ready_domain(domain, actions_m=[4.0])
    problem(walk.learn(), 410, "retired_map")


def test_what_cannot_be_learnt_from(client):
    walk = Walk(client, "ready", 3)
    problem(walk.learn(domain="seen"), 404, "unknown_session")
    path, session_id = "/v1/admin/domains/ready/experience", walk.session_id
    for body, status, code in (
        ('{"session_id": "%s", "true_positions_m": [1]}' % ("0" * 32), 404, "unknown_session"),
        (f'{{"session_id": "{session_id}", "true_positions_m": [1, 2]}}', 422, "invalid_input"),
        (f'{{"session_id": "{session_id}", "true_positions_m": [1, NaN, 2]}}', 422, "invalid_input"),
        (f'{{"session_id": "{session_id}", "true_positions_m": []}}', 422, "invalid_request"),
        (f'{{"session_id": "{session_id}", "true_positions_m": ["a", 1, 2]}}', 422, "invalid_request"),
        (f'{{"session_id": "{session_id}"}}', 422, "invalid_request"),
    ):
        problem(client.post(path, content=body, headers=JSON), status, code)
