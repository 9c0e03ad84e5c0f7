"""What the client reports, the service's own metrics say too; a map made here equals one made over HTTP."""

import json

import numpy as np
import pytest

from deepsimbad.cli import run
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map
from deepsimbad_campus.season import PAPER_DATES
from deepsimbad_client import Client
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay.passive import replay
from deepsimbad_client.replay.report import summarise

N_LANDMARKS = 20
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def campus(rendered):
    """The recordings' SOURCEs by season."""
    return {season: f"nclt:{rendered}/{PAPER_DATES[season]}" for season in ("winter", "spring")}


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


@pytest.mark.parametrize("relevance", ["composed", "standardised", "rrf"])
def test_a_replay_has_the_anr_of_the_experiment(service, tmp_path, relevance):
    """The same drive and map give the same number over HTTP and offline."""
    client, _ = service
    rng = np.random.default_rng(7)
    places = rng.normal(size=(150, 32)) + np.cumsum(rng.normal(size=(150, 32)), axis=0) / 4
    for season, spread in (("autumn", 0.8), ("spring", 0.3), ("summer", 3.5)):
        season_of = (places + rng.normal(size=32) + spread * rng.normal(size=places.shape)).astype(np.float32)
        np.save(tmp_path / f"{season}.npy", season_of)
    autumn, spring, summer = (str(tmp_path / f"{season}.npy") for season in ("autumn", "spring", "summer"))
    domain = f"vectors-{relevance}"
    client.admin.put_domain(domain, {"kind": "feature_l2", "extractor": "none"})
    for season in (autumn, spring):
        upload(client, open_source(season), domain, open_source(season).name)
    settings = {"n_landmarks": 60, "list_length": 4, "relevance": relevance}
    remap(client, domain, "spring", landmark_traverse="autumn", same_route=True, training_episodes=0, **settings)
    summary = summarise(replay(client, open_source(summer), domain, tmp_path / "replay", tolerance_m=2))
    words = ("experiment", "vpr", "--landmarks", autumn, "--training", spring, "--test", summer, "--n-landmarks", "60")
    options = ("--list-length", "4", "--tolerance", "2", "--relevance", relevance, "--json", str(tmp_path / "vpr.json"))
    assert run([*words, *options]) == 0
    experiment = json.loads((tmp_path / "vpr.json").read_text())
    assert 0.5 < summary["anr"] < 40, "else nothing is shown"
    assert summary["anr"] == pytest.approx(experiment["anr"][relevance], abs=1e-12)
    assert summary["recall_at_1"] == pytest.approx(experiment["recall_at_1"][relevance])
    assert (summary["n_queries"], summary["n_left_out"]) == (experiment["n_queries"], experiment["n_left_out"])


def test_a_map_made_here_equals_one_made_over_http(campus, service, tmp_path):
    _, data_dir = service
    drives = ("--landmarks", campus["winter"], "--training", campus["spring"], "--n-landmarks", str(N_LANDMARKS))
    drives += ("--allow-missing",)
    assert run(["map", "campus", "--data-dir", str(tmp_path), *drives]) == 0
    maps = []
    for folder in (data_dir, tmp_path):
        with Catalog.open(folder) as catalog:
            maps.append(read_map(catalog.map_path("campus", 1)))
    over_http, local = maps
    assert np.array_equal(over_http.landmark_model["prototypes"], local.landmark_model["prototypes"])
    for name in ("lists", "statistics", "usual_encoding", "view_bits", "position_m", "x_m", "timestamp_us"):
        assert np.array_equal(getattr(over_http, name), getattr(local, name)), name
