"""What the client reports, the service's own metrics say too; a map made here equals one made over HTTP."""

import os
import subprocess
import sys

import numpy as np
import pytest

from deepsimbad.core.metrics import RetrievalScorer
from deepsimbad.core.true_images import true_images_of
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.encoded_traverse import encode_recording
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map
from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_campus.writer import write_campus
from deepsimbad_client import Client
from deepsimbad_client.http.jobs import remap
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay import replay
from deepsimbad_client.report import summarise

N_FRAMES, N_LANDMARKS, TOLERANCE_M = 40, 20, 3.0
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def campus(tmp_path_factory):
    """SOURCE by season."""
    root = tmp_path_factory.mktemp("campus")
    seasons = ("winter", "spring", "summer")
    write_campus(root, seasons, N_FRAMES, 1)
    return {season: f"nclt:{root}/{PAPER_DATES[season]}" for season in seasons}


@pytest.fixture(scope="module")
def service(campus, tmp_path_factory):
    """A client of a service that mapped the spring."""
    folder = tmp_path_factory.mktemp("service")
    with LocalServer(folder / "data") as server, Client(server.url) as client:
        client.admin.put_domain("campus", {"kind": "feature_l2"})
        for season in ("winter", "spring"):
            upload(client, open_source(campus[season]), "campus", season)
        remap(client, "campus", "spring", landmark_traverse="winter", n_landmarks=N_LANDMARKS)
        yield client, folder / "data"


def test_the_clients_anr_is_the_services(campus, service, tmp_path):
    client, _ = service
    live = open_source(campus["summer"])
    driven = replay(client, live, "campus", tmp_path, tolerance_m=TOLERANCE_M)
    summary = summarise(driven)

    judge = make_evaluator(evaluator_config({"kind": "feature_l2"}))
    routes = [
        encode_recording(open_source(campus[each]), judge, 10**7, lambda _: None).route for each in ("summer", "spring")
    ]
    input_size = client.domain("campus").input_size
    scorer = RetrievalScorer()
    for frame, truth in zip(live.frames, true_images_of(*routes, TOLERANCE_M), strict=True):
        image = live.image(frame, input_size)
        scorer.add(client.relevances("campus", image.body, content_type=image.content_type), truth)
    scores = scorer.result()
    assert scores.n_queries > N_FRAMES / 2
    assert summary["n_queries"] == scores.n_queries
    assert summary["n_left_out"] == scores.n_left_out
    assert summary["anr"] == pytest.approx(scores.anr, abs=1e-9)
    assert summary["recall_at_1"] == pytest.approx(scores.recall_at[1])
    assert summary["recall_at_5"] == pytest.approx(scores.recall_at[5])


def test_a_map_made_here_equals_one_made_over_http(campus, service, tmp_path):
    _, data_dir = service
    made = subprocess.run(
        [
            *(sys.executable, "-m", "deepsimbad", "map", "campus", "--data-dir", str(tmp_path)),
            *("--landmarks", campus["winter"], "--training", campus["spring"], "--n-landmarks", str(N_LANDMARKS)),
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "120"},
        check=False,
    )
    assert made.returncode == 0, made.stderr
    maps = []
    for folder in (data_dir, tmp_path):
        with Catalog.open(folder) as catalog:
            maps.append(read_map(catalog.map_path("campus", 1)))
    over_http, here = maps
    assert np.array_equal(over_http.lists, here.lists)
    assert np.array_equal(over_http.landmark_model["prototypes"], here.landmark_model["prototypes"])
    assert np.array_equal(over_http.statistics, here.statistics)
    assert np.array_equal(over_http.position_m, here.position_m)
    assert np.array_equal(over_http.x_m, here.x_m)
    assert np.array_equal(over_http.timestamp_us, here.timestamp_us)
