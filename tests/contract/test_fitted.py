"""Evaluators that are fitted to images, from upload to answers: what waits, what is learnt, what goes wrong by name."""

import sqlite3
from contextlib import closing

import cv2
import numpy as np
import pytest

from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad_client.http.on_board import OnBoardEncoder

from .conftest import encoded, image_body, of_one_process, problem, service

N, AT = 40, (0.3, 0.75)  # of a fit: while views are encoded, and in mid-training
SIAMESE = {"kind": "siamese", "extractor": "gradient_grid"}
REMAP = {"landmark_traverse": "first", "training_traverse": "second", "same_route": True}
REMAP |= {"n_landmarks": 16, "training_episodes": 0}


def street(season):
    """N views along a painted street, through a window that moves on; a season changes the light and the grain."""
    rng, light = np.random.default_rng(7), np.random.default_rng(season)
    street = cv2.resize(rng.integers(0, 255, (8, 120, 3), np.uint8), (N * 16 + 128, 96), interpolation=cv2.INTER_CUBIC)
    lit = 255 * (street / 255) ** (1 + 0.5 * season)
    return [
        np.clip(lit[:, 16 * n : 16 * n + 128] + light.normal(0, 6, (96, 128, 3)), 0, 255).astype(np.uint8)
        for n in range(N)
    ]


def drive(client, domain, name, season, n=N):
    """Upload the first `n` pictures of a drive; the answers to the uploads."""
    client.post(f"/v1/admin/domains/{domain}/traverses", json={"name": name})
    frames = f"/v1/admin/domains/{domain}/traverses/{name}/frames"
    return [
        client.put(f"{frames}/{at}?position_m={at}", **image_body(picture, "png"))
        for at, picture in enumerate(street(season)[:n])
    ]


def n_waiting(client, domain, name):
    traverse = client.get(f"/v1/admin/domains/{domain}/traverses/{name}").json()
    return traverse["n_spooled"], traverse["spooled_bytes"]


def make(client, domain, evaluator=SIAMESE):
    client.make_domain(domain, evaluator=evaluator)
    for name, season in (("first", 0), ("second", 1)):
        assert {answer.status_code for answer in drive(client, domain, name, season)} == {201}


@pytest.fixture
def _short_fit(monkeypatch):
    """For tests of the way of a fit, not of what it learns."""
    monkeypatch.setattr("deepsimbad.evaluators.siamese._EPOCHS", 8)
    monkeypatch.setattr("deepsimbad.evaluators.autoencoder._EPOCHS", 30)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["siamese", "autoencoder"])
@pytest.mark.usefixtures("_short_fit")
def test_images_wait_are_fitted_and_deleted_and_the_map_answers_every_kind_of_view(client, tmp_path, kind):
    domain, views = f"fitted-{kind}", street(2)
    make(client, domain, {**SIAMESE, "kind": kind})
    assert n_waiting(client, domain, "first") == (N, sum(len(encoded(picture, ".png")) for picture in street(0)))
    metrics = client.make_map(domain, **REMAP)["result"]["metrics"]
    assert [n_waiting(client, domain, name) for name in ("first", "second")] == [(0, 0)] * 2
    fitting = metrics["fitting"]
    assert (fitting["n_views"], fitting["n_shared_places"], fitting["seed"]) == (128, N, 0)
    assert fitting["n_dissimilarities"] > 1000
    assert fitting["curve"]
    assert set(fitting["held_out"]) == {kind, "l2"}
    assert metrics["seconds"]["fit"] > 0
    assert metrics["second_season"]["accepted"]
    assert not [warning for warning in metrics["warnings"] if warning.startswith("fitted_without_images")]

    encoder, map_images = OnBoardEncoder(client.get(f"/v1/domains/{domain}/landmark-model").content), []
    session = client.session(domain)
    for at, picture in list(enumerate(views))[::3]:
        view, ranks = image_body(picture, "png"), encoder.ranks(picture, m=16)
        map_images.append(client.localize(domain, view)["retrieval"][0]["map_image"])
        client.localize(domain, {"content": ranks.body, "headers": ranks.headers})
        belief = client.observe(session, view, action_m=min(at, 3))["belief"]
    assert np.mean(np.abs(np.array(map_images) - np.arange(0, N, 3)) <= 2) > 0.8
    assert abs(belief["mode_m"] - (N - 1)) <= 2

    # Landmarks, and what was fitted, stay
    retraining = client.make_map(domain, training_traverse="first", training_episodes=0)
    assert "fitting" not in retraining["result"]["metrics"]
    assert drive(client, domain, "third", 2)[-1].status_code == 201
    append_job = client.remap(domain, training_traverse="third", append=True, same_route=True)
    assert append_job["result"]["metrics"]["fused"]["accepted"], append_job


@of_one_process
@pytest.mark.slow
@pytest.mark.usefixtures("_short_fit")
def test_views_that_were_kept_serve_the_next_fit_and_without_any_it_says_so(client, monkeypatch):
    make(client, "kept")
    encoded_images = []
    encode = FeatureL2.encode
    monkeypatch.setattr(FeatureL2, "encode", lambda self, images: encoded_images.extend(images) or encode(self, images))
    first_job = client.remap("kept", **REMAP)
    assert len(encoded_images) == 128
    client.make_map("kept", **{**REMAP, "n_landmarks": 12, "relevance": "rrf"})
    assert len(encoded_images) == 128, "the twelve are among the sixteen"
    other_job = client.remap("kept", **{**REMAP, "landmark_traverse": "second", "training_traverse": "first"})
    metrics = other_job["result"]["metrics"]
    (warning,) = (text for text in metrics["warnings"] if text.startswith("fitted_without_images: "))
    assert ("16 of 16 landmarks" in warning, metrics["fitting"]["n_views"]) == (True, 0)
    repeated_job = client.remap("kept", **REMAP)
    path = "/v1/domains/kept/landmark-model?map_version="
    versions = [job["result"]["map_version"] for job in (first_job, repeated_job, other_job)]
    etags = [client.get(f"{path}{version}").headers["etag"] for version in versions]
    assert etags[0] == etags[1] != etags[2]


@pytest.mark.usefixtures("_short_fit")
def test_a_full_spool_refuses_the_frame_and_loses_nothing(tmp_path):
    size = len(encoded(street(0)[0], ".png"))
    with service(tmp_path, max_spool_bytes=int(12.5 * size)) as client:
        client.make_domain("small", evaluator=SIAMESE)
        answers = drive(client, "small", "first", 0, 14)
        n_taken = sum(answer.status_code == 201 for answer in answers)
        assert 11 <= n_taken < 14
        document = problem(answers[-1], 409, "spool_full")
        assert document["limit"] == "max_spool_bytes"
        assert "first" in document["detail"]
        assert n_waiting(client, "small", "first")[0] == n_taken
        client.make_map("small", training_traverse="first", training_episodes=0)
        assert {answer.status_code for answer in drive(client, "small", "second", 1, n_taken)} == {201}
        replacement = drive(client, "small", "first", 0, 1)[0]
        assert replacement.status_code in {200, 409}
        assert client.delete("/v1/admin/domains/small/traverses/second").status_code == 204
        assert drive(client, "small", "first", 0, 1)[0].status_code == 200, "a deleted traverse makes room"


@pytest.mark.usefixtures("_short_fit")
def test_a_fit_that_is_cancelled_or_cannot_be_leaves_the_spool(tmp_path, monkeypatch):
    monkeypatch.setattr("deepsimbad.jobs.progress._INTERVAL_S", 0.0)  # every share is told, however fast the fit is
    states = []

    def run_job(job, on_progress, is_cancelled):
        def look(state):
            states.append(state)
            on_progress(state)
            if cancels and state.stage == "fit" and state.progress > cancels[0]:
                client.delete(f"/v1/admin/jobs/{job.job_id}")

        return InThisProcess(tmp_path)(job, look, is_cancelled)

    cancels = list(AT)
    with service(tmp_path, run_job) as client:
        make(client, "stopped")
        while cancels:
            assert client.remap("stopped", **REMAP)["state"] == "cancelled"
            assert [n_waiting(client, "stopped", name)[0] for name in ("first", "second")] == [N, N]
            cancels.pop(0)
        with closing(sqlite3.connect(tmp_path / "domains/stopped/traverses/first.sqlite")) as db:
            assert db.execute("SELECT count(*) FROM view_encoding").fetchone()[0] > 0, "what is done need not be again"
        failed_job = client.remap("stopped", **{**REMAP, "n_landmarks": 1, "list_length": 1})
        assert failed_job["error"]["code"] == "too_few_to_fit"
        assert n_waiting(client, "stopped", "first")[0] == N
        client.make_map("stopped", **REMAP)
        assert [state.stage for state in states if state.eta_s is not None and state.stage == "fit"]


def test_a_frame_that_is_replaced_takes_what_waited_with_it(client):
    client.make_domain("replaced", evaluator=SIAMESE)
    drive(client, "replaced", "first", 0, 3)
    frames = "/v1/admin/domains/replaced/traverses/first/frames"
    assert drive(client, "replaced", "first", 1, 1)[0].status_code == 200
    assert n_waiting(client, "replaced", "first")[0] == 3
    ready = np.ones(FeatureL2("gradient_grid").encoding_dim or 0).tolist()
    client.put(f"{frames}/0?position_m=0", json={"encoding": ready})
    assert n_waiting(client, "replaced", "first")[0] == 2
    client.make_domain("plain", evaluator={"kind": "feature_l2", "extractor": "gradient_grid"})
    drive(client, "plain", "first", 0, 2)
    assert n_waiting(client, "plain", "first") == (0, 0), "images of an evaluator that is not fitted do not wait"
