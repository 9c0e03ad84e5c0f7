"""`/v1/.../sessions`: what the answers hold, requests repeated under one key, and how sessions end."""

import asyncio
import io
import json
import math
import time
from datetime import UTC, datetime

import httpx2
import numpy as np
import pytest

from deepsimbad.api import requests
from deepsimbad.api.app import create_app

from .conftest import (
    DIM,
    IS_FLEET,
    N_LANDMARKS,
    N_READY,
    RANKS,
    image_body,
    of_one_process,
    path_of,
    picture,
    problem,
    ready_encodings,
    service,
    small_settings,
    wait_until,
)

STATE = {"session_id", "domain", "map_version", "n_observations", "expires_at", "belief", "next_best_view"}


def observe(client, path, action_m=0, **headers):
    return client.post(f"{path}/observations?action_m={action_m}", json=RANKS, headers=headers)


def see(client, path, image, action_m=0.0, **query):
    """An observation of what a map image shows, hardly changed."""
    return client.observe(path, {"encoding": (ready_encodings()[image] + 0.1).tolist()}, action_m=action_m, **query)


@of_one_process
def test_long_answers_of_every_route_are_written_beside_the_loop(client, monkeypatch):
    n_beside = 0
    run_sync = requests.run_sync

    async def counting(run, *arguments, limiter=None):
        nonlocal n_beside
        n_beside += limiter is client.services.long_work
        return await run_sync(run, *arguments, limiter=limiter)

    monkeypatch.setattr(requests, "run_sync", counting)
    monkeypatch.setattr(requests, "LONG_LIST", 20)
    path = client.session()
    calls = [
        ("POST", "/v1/domains/ready/localizations", RANKS),
        ("POST", f"{path}/observations", RANKS),
        ("GET", path, None),
        ("GET", f"{path}/belief", None),
    ]
    for shortlist, n_expected in ((20, 0), (21, 2 * len(calls))):  # rendered, and written as JSON
        for method, url, body in calls:
            answer = client.answer_to(method, url, params={"shortlist": shortlist}, json=body)
            assert len(answer.get("belief", answer)["top"]) == shortlist
        assert n_beside == n_expected


def test_a_session_from_beginning_to_end(client):
    session = client.begin()
    assert set(session) == STATE
    assert (session["domain"], session["map_version"], session["n_observations"]) == ("ready", 1, 0)
    left = datetime.fromisoformat(session["expires_at"]) - datetime.now(UTC)
    assert 3590 < left.total_seconds() <= 3600
    assert session["belief"]["entropy_bits"] == pytest.approx(math.log2(N_READY), abs=0.01)

    path = path_of(session)
    first_answer = client.observe(path, shortlist=3)
    assert set(first_answer) == STATE | {"timings_ms", "retrieval", "informative", "warnings"}
    assert first_answer["n_observations"] == 1
    assert len(first_answer["retrieval"]) == len(first_answer["belief"]["top"]) == 3
    relevance = [place["relevance"] for place in first_answer["retrieval"]]
    assert relevance == sorted(relevance, reverse=True)
    assert set(first_answer["next_best_view"]) == {"planner", "action_m", "stop", "actions"}

    second_answer = client.observe(path, action_m=4, action_std_m=0.5)
    assert second_answer["n_observations"] == 2
    state = client.get(path).json()
    assert set(state) == STATE
    assert state["belief"] == second_answer["belief"] == client.get(f"{path}/belief").json()
    assert state["next_best_view"] == second_answer["next_best_view"] == client.get(f"{path}/next-best-view").json()
    response = client.get(f"{path}/belief", headers={"Accept": "application/octet-stream"})
    assert response.headers["content-type"] == "application/octet-stream"
    mass = np.load(io.BytesIO(response.content))
    assert (mass.dtype, mass.shape) == (np.float32, (N_READY,))
    assert mass.sum() == pytest.approx(1)
    assert int(mass.argmax()) == second_answer["belief"]["top"][0]["map_image"]

    prior = client.answer_to("PUT", f"{path}/prior", json={"position_m": 30, "std_m": 2.5})
    assert set(prior) == STATE
    assert (prior["belief"]["mode_m"], prior["n_observations"]) == (30, 2)
    slack_prior = client.answer_to("PUT", f"{path}/prior", json={"position_m": -2, "std_m": 1})
    assert slack_prior["belief"]["mode_m"] == 0, "a little beside the route is allowed"

    assert client.delete(path).status_code == 204
    for late_answer in (client.get(path), client.delete(path), observe(client, path)):
        assert problem(late_answer, 410, "ended_session")["ending"] == "deleted"


def test_a_start_a_planner_and_a_filter_may_be_chosen(client):
    body = {"start_position_m": 20, "start_std_m": 1, "seed": 4, "belief": "particle", "planner": "constant:7"}
    session = client.begin(**body, update="additive_relevance")
    assert session["belief"]["mean_m"] == pytest.approx(20, abs=0.5)
    assert (session["next_best_view"]["planner"], session["next_best_view"]["action_m"]) == ("constant:7", 7)
    assert client.begin(**body, update="additive_relevance")["belief"] == session["belief"]
    nulls = client.begin(**dict.fromkeys(["start_position_m", "start_std_m", "seed", "belief", "planner", "update"]))
    assert nulls["belief"] == client.begin()["belief"]


def test_every_form_of_a_view(client):
    path = client.session()
    for place, view in enumerate(({"dissimilarities": RANKS["ranked_landmarks"]}, {"encoding": [0.5] * DIM}, RANKS)):
        assert client.observe(path, view)["n_observations"] == place + 1
    assert client.observe(client.session("seen"), image_body(picture(4)))["belief"]["mode_m"] == 4


@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_picture_of_nothing_says_nothing(client, belief):
    path = client.session("seen", belief=belief)
    old_belief = client.observe(path, image_body(picture(4)))["belief"]
    for shade in (0, 90, 255):
        answer = client.observe(path, image_body(np.full((120, 160, 3), shade, np.uint8)))
        assert (answer["informative"], answer["warnings"][0]) == (False, "the view told nothing of the place")
        assert answer["belief"]["entropy_bits"] >= old_belief["entropy_bits"] - 1e-9
        assert answer["belief"]["mode_m"] == old_belief["mode_m"]


@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_move_wholly_past_the_end_is_refused_unless_the_robot_is_lost(client, belief):
    path = client.session(start_position_m=78, start_std_m=0.5, belief=belief)
    assert see(client, path, 39)["belief"]["off_route"] < 0.05
    assert problem(observe(client, path, 50), 422, "past_the_end")["route_end_m"] == 78
    assert client.get(path).json()["n_observations"] == 1
    carried = client.session(start_position_m=78, start_std_m=0.5, belief=belief)
    see(client, carried, 10)
    assert see(client, carried, 11, 2)["belief"]["off_route"] > 0.05
    assert observe(client, carried, 50).status_code == 200


@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_route_ends_where_it_ends_within_the_error_of_a_move(client, belief):
    path = client.session(start_position_m=76, start_std_m=0.5, belief=belief)
    see(client, path, 38)
    for action_m in (2.2, 0.4):
        assert see(client, path, 39, action_m)["belief"]["mode_m"] == 78


def test_near_the_end_a_move_that_stays_is_recommended_and_where_none_does_it_is_said(client):
    warning = "every move probably leads past the end of the mapped route"
    near_end, at_end = (
        see(client, client.session(start_position_m=start_m, start_std_m=0.2), image)
        for start_m, image in ((76, 38), (78, 39))
    )
    assert near_end["belief"]["mode_m"] + near_end["next_best_view"]["action_m"] <= 78
    assert (warning in near_end["warnings"], warning in at_end["warnings"]) == (False, True)


def test_a_move_backward_within_its_error_is_none(client):
    beliefs = []
    for action_m in (0, -0.39):
        path = client.session(start_position_m=20, start_std_m=3)
        see(client, path, 10)
        beliefs.append(see(client, path, 11, action_m, action_std_m=0.1)["belief"])
    assert beliefs[0] == beliefs[1]
    problem(observe(client, path, "-0.41&action_std_m=0.1"), 422, "invalid_move")
    assert client.get(path).json()["n_observations"] == 2
    assert observe(client, path, "1&action_std_m=0").status_code == 200, "a move may be exact"


# How sure, and what to do about it


@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_robot_is_confident_when_it_knows_its_place_as_surely_as_it_asked_to(client, belief):
    def answer(confidence):
        path = client.session(belief=belief, confidence=confidence)
        first = see(client, path, 11, shortlist=N_READY)
        state = client.get(path).json()
        assert state["belief"]["confident"] is first["belief"]["confident"] is first["next_best_view"]["stop"]
        assert state["next_best_view"]["stop"] is first["next_best_view"]["stop"]
        return first["belief"]

    summary = answer(None)
    mass = sum(place["mass"] for place in summary["top"] if abs(place["route_position_m"] - summary["mode_m"]) <= 5)
    near_mass = mass * (1 - summary["off_route"])
    assert 0.1 < near_mass < 0.9
    assert not summary["confident"]
    assert [answer(near_mass + margin)["confident"] for margin in (-1e-6, 1e-6)] == [True, False]


@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_robot_that_was_carried_is_lost_and_found(client, belief):
    path = client.session(belief=belief)
    on_route = [see(client, path, image, 4) for image in range(0, 24, 2)]
    for image, answer in list(enumerate(on_route))[3:]:
        assert (answer["belief"]["mode_m"], answer["belief"]["confident"]) == (4 * image, True)
        assert (answer["belief"]["off_route"] < 0.01, answer["informative"], answer["warnings"]) == (True, True, [])
    carried = [see(client, path, image, 2) for image in range(30, 40)]
    lost = max(carried, key=lambda answer: answer["belief"]["off_route"])
    assert lost["belief"]["off_route"] > (0.5 if belief == "grid" else 0.4)
    assert not lost["belief"]["confident"]
    was_told = f"off_route is {lost['belief']['off_route']:.2f}" in " ".join(lost["warnings"])
    assert was_told == (lost["belief"]["off_route"] > 0.5)
    assert carried[-1]["belief"]["mode_m"] == 78
    assert carried[-1]["belief"]["off_route"] < 0.5


def test_metres_may_be_given_a_price(client):
    free_plan, dear_plan = (
        see(client, client.session(price_bits_per_m=price), 11)["next_best_view"] for price in (0, 100)
    )
    assert see(client, client.session(), 11)["next_best_view"] == free_plan
    assert (free_plan["action_m"] > 5, dear_plan["action_m"]) == (True, 1)
    bits = [[action["expected_bits"] for action in plan["actions"]] for plan in (free_plan, dear_plan)]
    assert bits[0] == bits[1]
    values = [action["q_value"] for action in dear_plan["actions"]]
    assert values == sorted(values, reverse=True)
    constant = client.begin(planner="constant:3", price_bits_per_m=0.0)["next_best_view"]
    assert {(action["q_value"], action["expected_bits"]) for action in constant["actions"]} == {(None, None)}
    for planner in ("constant:3", "nnql", "random"):
        refused = client.post("/v1/domains/ready/sessions", json={"planner": planner, "price_bits_per_m": 1.5})
        assert "leave one of the two out" in problem(refused, 422, "invalid_input")["detail"]


def test_the_credible_set_is_the_smallest_one(client):
    belief = see(client, client.session(), 11, shortlist=N_READY)["belief"]
    mass = 0.0
    members = []
    for place in belief["top"]:
        members.append(place["route_position_m"])
        mass += place["mass"]
        if mass >= 0.95:
            break
    pieces = []
    for position_m in sorted(members):
        if pieces and position_m - pieces[-1][1] <= 2:
            pieces[-1][1] = position_m
        else:
            pieces.append([position_m, position_m])
    assert len(pieces) > 1, "else nothing is shown"
    assert belief["credible_95_sets_m"] == pieces
    assert belief["credible_95_m"] == [min(members), max(members)]


# Once under one key


def test_an_idempotency_key_counts_once(client):
    path = client.session()
    key = {"Idempotency-Key": "view-1"}
    answers = [observe(client, path, 1, **key).json() for _ in range(3)]
    assert [answer["n_observations"] for answer in answers] == [1, 1, 1]
    assert answers[0]["belief"] == answers[1]["belief"] == answers[2]["belief"]
    one_landmark = {"ranked_landmarks": [1]}
    for query, body in (("2", RANKS), ("1&action_std_m=2", RANKS), ("1", one_landmark)):
        refused = client.post(f"{path}/observations?action_m={query}", json=body, headers=key)
        problem(refused, 422, "idempotency_key_reused")
    assert observe(client, path).json()["n_observations"] == 2
    assert observe(client, path, 1, **key).json()["belief"] == answers[0]["belief"]


def test_a_brief_answer_is_the_whole_one_without_its_lists(client):
    path, key = f"{client.session()}/observations", {"Idempotency-Key": "view-1"}
    for url, headers in ((path, key), ("/v1/domains/ready/localizations", {})):
        full_answer = client.answer_to("POST", url, json=RANKS, headers=headers)
        response = client.post(url, params={"brief": True}, json=RANKS, headers=headers)
        assert len(response.content) < 1000 < len(json.dumps(full_answer)) / 4
        brief_answer = response.json()
        for answer in (full_answer, brief_answer):
            del answer["timings_ms"]
        full_answer["belief"] |= {"histogram": {"edges_m": [], "mass": []}, "top": []}
        full_answer["next_best_view"]["actions"] = full_answer["retrieval"] = []
        assert brief_answer == full_answer


def test_a_session_begun_twice_under_one_key_is_one(client, domain):
    key = {"Idempotency-Key": "a-robot's-start"}
    body = {"seed": 3, "start_position_m": 20}

    def begin(content, headers=key, of=domain):
        return client.post(f"/v1/domains/{of}/sessions", json=content, headers=headers)

    first, repetition = begin(body), begin(body)
    assert (first.status_code, repetition.status_code) == (201, 201)
    assert first.json() == repetition.json()
    assert first.headers["location"] == repetition.headers["location"] == path_of(first.json())
    assert begin({**body, "planner": None, "start_std_m": 5.0}).json() == first.json()  # the same, written out
    assert len(client.get("/v1/admin/sessions", params={"domain": domain}).json()["sessions"]) == 1

    problem(begin({"seed": 4}), 422, "idempotency_key_reused")
    problem(begin({**body, "start_position_m": 1e9}), 422, "idempotency_key_reused")
    other_answers = [begin(body, {}), begin(body, {"Idempotency-Key": "another"}), begin(body, key, "ready")]
    assert len({answer.json()["session_id"] for answer in (first, *other_answers)}) == 4

    observe(client, path_of(first.json()))
    late = begin(body)
    assert (late.status_code, late.json()["n_observations"]) == (201, 1)
    client.delete(path_of(first.json()))
    problem(begin(body), 410, "ended_session")


def test_a_start_repeated_at_once_is_one_session_and_views_at_once_are_all_answered(tmp_path):
    with service(tmp_path) as client:
        client.make_ready_domain("d")

    async def at_once():
        app = create_app(small_settings(tmp_path))
        async with (
            app.router.lifespan_context(app),
            httpx2.AsyncClient(transport=httpx2.ASGITransport(app), base_url="http://service") as robot,
        ):
            key = {"Idempotency-Key": "together"}
            sessions = await asyncio.gather(
                *(robot.post("/v1/domains/d/sessions", json={}, headers=key) for _ in "12345")
            )
            assert {answer.status_code for answer in sessions} == {201}
            (path,) = {path_of(answer.json()) for answer in sessions}
            answers = await asyncio.gather(*(robot.post(f"{path}/observations", json=RANKS) for _ in range(8)))
            assert sorted(answer.json()["n_observations"] for answer in answers) == list(range(1, 9))
            assert (await robot.get(path)).json()["n_observations"] == 8
            assert len((await robot.get("/v1/admin/sessions")).json()["sessions"]) == 1

    asyncio.run(at_once())


# How they end


def test_limits_expiry_and_metrics(tmp_path):
    with service(tmp_path, max_sessions=2, session_sweep_s=0.05) as client:
        client.make_ready_domain("ready")
        first = client.session()
        client.begin()
        for _ in range(2):
            observe(client, first, **{"Idempotency-Key": "k"})
        observe(client, first, -1)
        full = client.post("/v1/domains/ready/sessions", json={})
        assert problem(full, 429, "too_many_sessions")["max_sessions"] == 2
        assert int(full.headers["retry-after"]) >= 1
        text = client.get("/metrics").text
        assert "deepsimbad_sessions 2.0" in text
        for outcome in ("accepted", "repeated", "invalid_move"):
            assert f'deepsimbad_observations_total{{outcome="{outcome}"}} 1.0' in text
        assert "deepsimbad_session_commit_writes_count" in text
        client.services.sessions._clock = lambda: time.time() + 4000
        wait_until(lambda: "deepsimbad_sessions 0.0" in client.get("/metrics").text)
        assert problem(client.get(first), 410, "ended_session")["ending"] == "expired"
        client.begin()


def test_whatever_breaks_a_sweep_the_next_one_comes(tmp_path, monkeypatch):
    moments_s = []

    async def sweep():
        moments_s.append(time.monotonic())
        raise RuntimeError("can't start new thread")

    with service(tmp_path, session_sweep_s=0.05) as client:
        monkeypatch.setattr(client.services.sessions, "sweep", sweep)
        wait_until(lambda: len(moments_s) > 1)


def test_a_restart_and_a_retired_map(tmp_path):
    key = {"Idempotency-Key": "k"}
    begin_under_key = {"json": {}, "headers": {"Idempotency-Key": "once"}}
    with service(tmp_path) as client:
        client.make_ready_domain("ready")
        session = client.post("/v1/domains/ready/sessions", **begin_under_key).json()
        path = path_of(session)
        first_answer = observe(client, path, **key).json()
        client.remap("ready", landmark_traverse="drive", n_landmarks=N_LANDMARKS - 1)
        assert client.get("/v1/domains/ready").json()["map_version"] == 2
        assert observe(client, path).json()["map_version"] == 1
    with service(tmp_path) as client:
        of_the_time = {"timings_ms": {}, "expires_at": ""}
        assert observe(client, path, **key).json() | of_the_time == first_answer | of_the_time
        assert client.get(path).json()["n_observations"] == 2
        answer = client.post("/v1/domains/ready/sessions", **begin_under_key)
        assert (answer.status_code, answer.json()["session_id"]) == (201, session["session_id"])
    (tmp_path / "domains" / "ready" / "maps" / "000001.sqlite").unlink()
    with service(tmp_path) as client:
        if not IS_FLEET:  # which has another of the file
            document = problem(observe(client, path), 410, "retired_map")
            assert "begin a new session" in document["detail"]
            assert document["map_version"] == 1
        assert client.delete(path).status_code == 204
        path = client.session()
        assert client.delete("/v1/admin/domains/ready").status_code == 204
        problem(client.get(path), 410, "ended_session")
        problem(client.get(f"{path}/events?after=0"), 410, "retired_map")  # which no stream can tell


# Any action set


BACK_AND_FORTH_M = [-6.0, 0.0, 2.0, 10.0]


@pytest.fixture(scope="module", params=[False, True], ids=["open", "closed"])
def back_and_forth(client, request):
    """A domain whose robot may be told to go back or to stay, and whether its route is a loop."""
    name = f"back-and-forth-{'closed' if request.param else 'open'}"
    client.make_ready_domain(name, closed=request.param, actions_m=BACK_AND_FORTH_M)
    assert client.get(f"/v1/domains/{name}").json()["actions_m"] == BACK_AND_FORTH_M
    return name, request.param


@pytest.mark.parametrize("belief", ["grid", "particle"])
def test_a_robot_that_goes_backward_is_followed(client, back_and_forth, belief):
    name, closed = back_and_forth
    path = client.session(name, start_position_m=20, start_std_m=0.5, belief=belief)
    image = 10
    see(client, path, image)
    for action_m in (10, -6, -6, 0, -0.4, -12, 2):
        image = round(image + action_m / 2) % N_READY
        position = see(client, path, image, action_m)["belief"]
        assert (position["mode_m"], position["off_route"] < 0.1) == (2 * image, True), action_m
    for action_m in ("-100.5", "100.5", "nan"):
        document = problem(observe(client, path, action_m), 422, "invalid_move")
        assert (document["minimum"], document["maximum"]) == (-100, 100)
    path = client.session(name, start_position_m=10, start_std_m=0.5, belief=belief)
    see(client, path, 5)
    far_move = observe(client, path, -50)
    if closed:
        assert far_move.status_code == 200, far_move.text
        return
    document = problem(far_move, 422, "past_the_end")
    assert (document["route_end_m"], "the route begins at 0 m" in document["detail"]) == (0, True)


@pytest.mark.parametrize("planner", ["informed", "nnql", "random", "constant:-6", "constant:0"])
def test_every_planner_chooses_among_all_moves_and_staying_is_no_stop(client, back_and_forth, planner):
    name, _ = back_and_forth
    path = client.session(name, planner=planner, confidence=0.999999, start_position_m=40, start_std_m=20)
    for image in (20, 17):
        plan = see(client, path, image, -6)["next_best_view"]
        assert (plan["planner"], plan["stop"]) == (planner, False)
        assert [action["action_m"] for action in plan["actions"]] == BACK_AND_FORTH_M
        assert plan["action_m"] in BACK_AND_FORTH_M
    if planner.startswith("constant"):
        assert plan["action_m"] == float(planner.partition(":")[2])
    if planner == "informed":
        bits = {action["action_m"]: action["expected_bits"] for action in plan["actions"]}
        assert bits[0] == 0 < min(bits[-6], bits[2], bits[10])
        dear_path = client.session(name, planner=planner, confidence=0.999999, price_bits_per_m=100)
        plan = see(client, dear_path, 20)["next_best_view"]
        assert (plan["action_m"], plan["stop"]) == (0, False), "moving is too dear, and the place is not known"
    sure_path = client.session(name, planner=planner, confidence=0.5, start_position_m=40, start_std_m=0.1)
    assert see(client, sure_path, 20)["next_best_view"]["stop"] is True, "whatever the next move would be"
    problem(client.post(f"/v1/domains/{name}/sessions", json={"planner": "constant:-2"}), 422, "invalid_input")
