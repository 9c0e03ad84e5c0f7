"""The admin calls that make and fill a domain, and the jobs they begin: each once, only so many, told to the end."""

import errno
import hashlib
import json
import threading
from io import BytesIO

import cv2
import numpy as np
import pytest

from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.store import catalog

from .conftest import (
    DIM,
    NPZ,
    RANKS,
    TAKES_ENCODINGS,
    TAKES_IMAGES,
    encoded,
    image_body,
    npz,
    of_one_process,
    path_of,
    picture,
    problem,
    ready_encodings,
    service,
)

REMAP = {"training_traverse": "drive", "training_episodes": 0}
KEY = {"Idempotency-Key": "season-4/remap"}
WITHIN_S = 60


def test_a_domain_is_made_once(client):
    first = client.put("/v1/admin/domains/once", json=TAKES_ENCODINGS)
    repetition = client.put("/v1/admin/domains/once", json={**TAKES_ENCODINGS, "closed": False})
    assert (first.status_code, repetition.status_code) == (201, 200)
    assert first.json() == repetition.json() == client.get("/v1/domains/once").json()
    assert first.json()["actions_m"] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    written_out = {"evaluator": client.make_domain("defaults", **TAKES_IMAGES)["evaluator"]}
    assert client.put("/v1/admin/domains/defaults", json=written_out).status_code == 200


def test_a_limit_on_domains(tmp_path):
    with service(tmp_path, max_domains=2) as client:
        answers = [client.put(f"/v1/admin/domains/{name}", json=TAKES_ENCODINGS) for name in ("a", "b", "c", "b")]
        assert [answer.status_code for answer in answers] == [201, 201, 409, 200]
        assert problem(answers[2], 409, "too_many_domains")["max_domains"] == 2
        assert client.delete("/v1/admin/domains/a").status_code == 204
        assert client.put("/v1/admin/domains/c", json=TAKES_ENCODINGS).status_code == 201


def test_a_deleted_domain_is_gone_and_its_name_free(client, domain):
    answer = client.delete(f"/v1/admin/domains/{domain}")
    assert (answer.status_code, answer.content) == (204, b"")
    assert client.post(f"/v1/domains/{domain}/localizations", json=RANKS).status_code == 404
    client.make_ready_domain(domain, closed=True)
    assert client.get(f"/v1/domains/{domain}").json()["closed"] is True


@of_one_process
def test_a_domain_whose_folder_cannot_be_removed_is_gone_with_its_sessions(client, domain, monkeypatch):
    def fail(folder):
        raise OSError(errno.EIO, "Input/output error", str(folder))

    session = client.session(domain)
    with monkeypatch.context() as patched:
        patched.setattr(catalog, "bury", fail)
        assert client.delete(f"/v1/admin/domains/{domain}").status_code == 503
    problem(client.post(f"{session}/observations", json=RANKS), 410, "ended_session")
    assert client.post(f"/v1/domains/{domain}/localizations", json=RANKS).status_code == 404
    assert f'domain="{domain}"' not in client.get("/metrics").text


# Traverses

EMPTY = dict.fromkeys(("length_m", "span_us", "digest", "grey_levels"))
EMPTY |= {"name": "t", "n_frames": 0, "missing": [], "n_uninformative": 0, "n_spooled": 0}
EMPTY |= {"spooled_bytes": 0, "cameras": [], "warnings": []}


@pytest.fixture
def shelf(client, request):
    """A domain's traverses, of which there is one, `t`."""
    base = f"/v1/admin/domains/{request.node.name.replace('_', '-')[:60]}"
    client.put(base, json=TAKES_ENCODINGS)
    answer = client.post(f"{base}/traverses", json={"name": "t"})
    assert (answer.status_code, answer.json()) == (201, EMPTY)
    return f"{base}/traverses"


def test_traverses_are_made_listed_and_deleted(client, shelf):
    assert client.post(shelf, json={"name": "t"}).status_code == 200
    client.post(shelf, json={"name": "a"})
    assert [traverse["name"] for traverse in client.get(shelf).json()["traverses"]] == ["a", "t"]
    frame = {"encoding": [1.0] * DIM}
    assert client.put(f"{shelf}/t/frames/0?position_m=1", json=frame).status_code == 201
    answer = client.put(f"{shelf}/t/frames/1?position_m=1", json={"encoding": [1.0]})
    problem(answer, 422, "invalid_encoding")  # the first frame decides how long they are
    assert client.delete(f"{shelf}/t").status_code == 204
    assert client.get(f"{shelf}/t").status_code == 404
    assert [traverse["name"] for traverse in client.get(shelf).json()["traverses"]] == ["a"]
    assert client.put(f"{shelf}/t/frames/0?position_m=1", json=frame).status_code == 404
    assert client.post(shelf, json={"name": "t"}).status_code == 201
    assert client.put(f"{shelf}/t/frames/0?position_m=1", json={"encoding": [1.0]}).status_code == 201


def test_frames_twice_and_out_of_order(client, shelf):
    answers = []
    for index in (5, 0, 2, 5):
        place = {"position_m": index, "timestamp_us": index, "x_m": 1, "y_m": 2}
        answer = client.put(f"{shelf}/t/frames/{index}", params=place, json={"encoding": [float(index)] * DIM})
        answers.append((answer.status_code, answer.json()["index"], answer.json()["n_frames"]))
    assert answers == [(201, 5, 1), (201, 0, 2), (201, 2, 3), (200, 5, 3)]
    description = client.get(f"{shelf}/t").json()
    assert len(description["digest"]) == 64
    told_by_frames = {"n_frames": 3, "missing": [[1, 1], [3, 4]], "length_m": 5.0, "span_us": [0, 5]}
    assert description == {**EMPTY, **told_by_frames, "digest": description["digest"]}
    batch = npz(encodings=np.ones((3, DIM)), index=np.array([4, 2, 3]), position_m=np.array([4, 2, 3]))
    answer = client.post(f"{shelf}/t/frames", content=batch, headers=NPZ)
    assert (answer.status_code, answer.json()) == (200, {"n_new": 2, "n_replaced": 1, "n_frames": 5})


def test_what_is_there_stays_where_nothing_may_be_replaced(client, shelf):
    frames_there = {"encodings": np.eye(DIM)[:3], "index": np.arange(3), "position_m": np.arange(3.0)}
    frames = f"{shelf}/t/frames"
    assert client.post(f"{frames}?replace=false", content=npz(**frames_there), headers=NPZ).json()["n_new"] == 3
    description = client.get(f"{shelf}/t").json()

    answer = client.post(f"{frames}?replace=false", content=npz(**frames_there), headers=NPZ)
    assert answer.json() == {"n_new": 0, "n_replaced": 0, "n_frames": 3}
    encoding = {"encoding": np.eye(DIM)[1].tolist()}
    assert client.put(f"{frames}/1?position_m=1&replace=false", json=encoding).status_code == 200
    for changes, indices, difference in (
        ({"position_m": np.array([0.0, 5, 6])}, [1, 2], "position"),
        ({"x_m": np.array([np.nan, 1, np.nan])}, [1], "x"),
        ({"timestamp_us": np.array([-1, -1, 7])}, [2], "time"),
        ({"encodings": np.eye(DIM)[[3, 1, 2]]}, [0], "content"),
    ):
        batch = npz(**{**frames_there, "index": np.arange(3), **changes})
        refusal = problem(client.post(f"{frames}?replace=false", content=batch, headers=NPZ), 409, "frames_differ")
        assert (refusal["indices"], refusal["n_differing"]) == (indices, len(indices))
        assert f"differ in {difference}," in refusal["detail"]
    answer = client.put(f"{frames}/1?position_m=4&replace=false", json=encoding)
    assert problem(answer, 409, "frames_differ")["indices"] == [1]
    assert client.get(f"{shelf}/t").json() == description
    digests = (hashlib.blake2b(row.astype("<f4").tobytes(), digest_size=8).digest() for row in np.eye(DIM)[:3])
    with np.load(BytesIO(client.get(frames).content)) as columns:
        assert columns["index"].tolist() == columns["position_m"].tolist() == [0, 1, 2]
        assert columns["timestamp_us"].tolist() == [-1] * 3
        assert np.isnan([columns["x_m"], columns["y_m"]]).all()
        assert columns["content_digest"].tolist() == [int.from_bytes(digest, "little") for digest in digests]


@pytest.mark.parametrize("dim", [64, 4096])
def test_a_domain_of_images_takes_ready_encodings_of_any_one_length(client, dim):
    name = f"any-{dim}"
    client.make_domain(name, **TAKES_IMAGES)
    encodings = np.random.default_rng(dim).integers(-9, 10, (20, dim)).astype(np.float16)
    client.upload(name, "drive", encodings, np.arange(20))
    image = image_body(picture(1))
    answer = client.put(f"/v1/admin/domains/{name}/traverses/drive/frames/20?position_m=20", **image)
    assert str(dim) in problem(answer, 422, "invalid_encoding")["detail"]
    client.make_map(name, landmark_traverse="drive", n_landmarks=20)
    assert client.localize(name, {"ranked_landmarks": [7, 3, 11]})["retrieval"]
    assert client.localize(name, {"encoding": encodings[13].tolist()})["retrieval"][0]["map_image"] == 13
    detail = problem(client.post(f"/v1/domains/{name}/localizations", **image), 422, "invalid_encoding")["detail"]
    assert f"landmarks of {dim}" in detail


def test_an_image_and_its_encoding_are_the_same_frame(client):
    frame = "/v1/admin/domains/seen/traverses/drive/frames/3?position_m=3"
    headers = {"Content-Type": "image/jpeg; charset=binary"}
    assert client.put(frame, content=encoded(picture(3)), headers=headers).status_code == 200
    dim = client.get("/v1/domains/seen").json()["encoding_dim"]
    assert client.put(frame, json={"encoding": [0.5]}).json()["encoding_dim"] == dim


def test_drives_of_two_cameras_are_told_from_upload_to_remap(client):
    """What is asked after a job depends on the map that it has made."""
    traverses = "/v1/admin/domains/cameras/traverses"
    client.make_domain("cameras", evaluator={"kind": "feature_l2", "extractor": "gradient_grid"})

    def warning_of(document):
        (warning,) = document["warnings"]
        return warning

    def warnings_of_remap(**config):
        return client.make_map("cameras", n_landmarks=8, **config)["result"]["metrics"]["warnings"]

    def lying_picture(n):
        return image_body(cv2.rotate(picture(n), cv2.ROTATE_90_CLOCKWISE))

    for name, body_of_picture in (("upright", lambda n: image_body(picture(n))), ("lying", lying_picture)):
        client.post(traverses, json={"name": name})
        for n in range(8):
            path = f"{traverses}/{name}/frames/{n}?position_m={n}&x_m={n}&y_m=0&camera=Cam5"
            assert client.put(path, **body_of_picture(n)).status_code == 201
    upright, lying = (client.get(f"{traverses}/{name}").json() for name in ("upright", "lying"))
    assert upright["cameras"] == [
        {"name": "Cam5", "width": 160, "height": 120, "aspect_ratio": 4 / 3, "orientation": "landscape"}
    ]
    assert (lying["cameras"][0]["width"], lying["cameras"][0]["orientation"]) == (120, "portrait")
    encoding = {"encoding": [0.5] * client.get("/v1/domains/cameras").json()["encoding_dim"]}
    answer = client.put(f"{traverses}/upright/frames/9?position_m=9&camera=Cam5", json=encoding)
    problem(answer, 422, "invalid_input")
    assert warning_of(lying).startswith("its pictures are not like those of traverse upright: they lie on their side")
    client.put(f"{traverses}/upright/frames/8?position_m=8", **lying_picture(7))
    (mixed,) = (row for row in client.get(traverses).json()["traverses"] if row["name"] == "upright")
    assert warning_of(mixed).startswith(
        "some of its pictures are not like the others: they lie on their side: they are 120 x 160"
    )
    assert warnings_of_remap(training_traverse="upright") == []
    for answer in (
        client.localize("cameras", lying_picture(1)),
        client.observe(client.session("cameras"), lying_picture(1)),
    ):
        assert warning_of(answer).startswith("the view's pixels are not like the map's: they lie on their side")
    season_warning, warning = warnings_of_remap(training_traverse="upright", landmark_traverse="lying")
    assert season_warning.startswith("it learnt nothing of a second season: the two drives share 8 places")
    beginning = "the pictures of traverse lying are not like those of"
    assert warning.startswith(f"{beginning} traverse upright: they lie on their")
    (warning,) = warnings_of_remap(training_traverse="lying", append=True)
    assert warning.startswith(f"{beginning} the active map: they lie on their")
    warnings = client.localize("cameras", lying_picture(1))["warnings"]
    assert not any("pixels" in warning for warning in warnings), "such pictures are in the map by now"


# Jobs


def test_what_a_job_needs_is_not_deleted(client, domain):
    base = f"/v1/admin/domains/{domain}"
    client.upload(domain, "day", ready_encodings(), np.arange(40))
    config = {"training_traverse": "drive", "check_traverse": "day"}
    job = client.services.catalog.create_job(domain, "remap", config)  # one that waits
    for place in (f"{base}/traverses/drive", f"{base}/traverses/day", base):
        problem(client.delete(place), 409, "traverse_in_use")
    assert client.delete(f"/v1/admin/jobs/{job.job_id}").status_code == 204
    assert client.delete(f"{base}/traverses/drive").status_code == 204
    client.localize(domain)
    assert client.delete(base).status_code == 204


def test_a_remap_is_followed_by_its_events(client, domain):
    config = {"training_traverse": "drive", "relevance": "rrf", "seed": 3}
    answer = client.post(f"/v1/admin/domains/{domain}/remaps", json=config)
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/admin/jobs/{answer.json()['job_id']}"
    with client.stream("GET", f"{answer.headers['location']}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        lines = list(stream.iter_lines())
    events = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    job = [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")][-1]
    assert events[-1] == "done"
    assert set(events[:-1]) <= {"progress"}
    assert job == client.get(answer.headers["location"]).json()
    assert set(job) >= {"job_id", "domain", "state", "stage", "progress", "eta_s", "result", "error"}
    assert (job["state"], job["progress"], job["error"], job["config"]["seed"]) == ("succeeded", 1, None, 3)
    assert set(job["result"]) == {"map_version", "active", "metrics"}
    assert client.get(f"/v1/domains/{domain}").json()["relevance"] == "rrf"
    jobs = client.get(f"/v1/admin/jobs?domain={domain}").json()["jobs"]
    assert [job["result"]["map_version"] for job in jobs] == [2, 1]
    assert jobs[0] in client.get("/v1/admin/jobs").json()["jobs"]


class HoldingRunner:
    """Does jobs in this process; while it is held, none begins."""

    def __init__(self, data_dir):
        self.entered, self.free = threading.Event(), threading.Event()
        self.free.set()
        self._run_job = InThisProcess(data_dir)

    def __call__(self, *job):
        self.entered.set()
        assert self.free.wait(WITHIN_S)
        return self._run_job(*job)


@pytest.fixture
def held_runner(tmp_path):
    held_runner = HoldingRunner(tmp_path)
    with service(tmp_path, held_runner, max_jobs=2) as client:
        client.make_ready_domain("ready")
        yield client, held_runner
        held_runner.free.set()


def ask(client, path, body, key=KEY, domain="ready"):
    return client.post(f"/v1/admin/domains/{domain}/{path}", json=body, headers=key)


def test_a_remap_asked_for_twice_under_one_key_is_one(tmp_path):
    with service(tmp_path) as client:
        client.make_ready_domain("ready")
        first = ask(client, "remaps", REMAP)
        first_job = client.wait_for(first.json()["job_id"])
        assert (first.status_code, first_job["state"]) == (202, "succeeded")
    with service(tmp_path) as client:  # after a restart too
        repetition = ask(client, "remaps", {**REMAP, "seed": 0, "landmark_traverse": None})  # the same, written out
        assert (repetition.status_code, repetition.json()) == (202, first_job)
        assert repetition.headers["location"] == first.headers["location"] == f"/v1/admin/jobs/{first_job['job_id']}"
        assert len(client.get("/v1/admin/jobs").json()["jobs"]) == 2
        problem(ask(client, "remaps", {**REMAP, "seed": 1}), 422, "idempotency_key_reused")
        client.make_ready_domain("elsewhere")
        answers = [ask(client, "remaps", REMAP, key) for key in ({}, {}, {"Idempotency-Key": "another"})]
        answers.append(ask(client, "remaps", REMAP, domain="elsewhere"))
        jobs = [client.wait_for(answer.json()["job_id"]) for answer in answers]
        assert len({first_job["job_id"], *(job["job_id"] for job in jobs)}) == 5
        assert jobs[-1]["domain"] == "elsewhere"
        client.delete("/v1/admin/domains/ready/traverses/drive")
        assert ask(client, "remaps", REMAP).json() == first_job, "what was done needs its traverse no more"
        problem(ask(client, "remaps", REMAP, {}), 404, "unknown_traverse")


def test_experience_fed_back_twice_under_one_key_is_learnt_once(client, domain):
    session = client.begin(domain)
    for image in range(0, 8, 2):
        client.observe(path_of(session), {"encoding": ready_encodings()[image].tolist()}, action_m=4)
    truths = {"session_id": session["session_id"], "true_positions_m": [0.0, 4.0, None, 12.0]}
    first = ask(client, "experience", truths, domain=domain)
    assert first.status_code == 202, first.text
    first_job = client.wait_for(first.json()["job_id"])
    assert ask(client, "experience", truths, domain=domain).json() == first_job
    other = {**truths, "true_positions_m": [0.0, 4.0, 8.0, 12.0]}
    problem(ask(client, "experience", other, domain=domain), 422, "idempotency_key_reused")
    job = client.wait_for(ask(client, "experience", other, {}, domain).json()["job_id"])
    assert job["job_id"] != first_job["job_id"]
    assert client.wait_for(ask(client, "remaps", REMAP, domain=domain).json()["job_id"])["kind"] == "remap"
    metric = f'deepsimbad_live_anr_percent_count{{domain="{domain}"}} 4.0'
    assert metric in client.get("/metrics").text, "every truth counts once"


def test_only_so_many_jobs_wait(held_runner):
    client, runner = held_runner
    runner.entered.clear()
    runner.free.clear()
    ask(client, "remaps", REMAP, {})
    assert runner.entered.wait(WITHIN_S)
    job_ids = [ask(client, "remaps", REMAP, key).json()["job_id"] for key in ({}, KEY)]
    full = ask(client, "remaps", REMAP, {})
    document = problem(full, 429, "too_many_jobs")
    assert (document["limit"], document["max_jobs"], full.headers["retry-after"]) == ("max_jobs", 2, "30")
    assert ask(client, "remaps", REMAP).json()["job_id"] == job_ids[1], "one that is known needs no room"
    client.delete(f"/v1/admin/jobs/{job_ids[0]}")
    last = ask(client, "remaps", REMAP, {})
    assert last.status_code == 202, last.text
    runner.free.set()
    assert client.wait_for(last.json()["job_id"])["state"] == "succeeded"
    assert client.wait_for(job_ids[0])["state"] == "cancelled"
    assert client.delete(f"/v1/admin/jobs/{job_ids[0]}").status_code == 204, "it stays cancelled"
