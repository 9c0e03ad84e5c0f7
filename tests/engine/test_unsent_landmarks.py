"""How landmarks go together is kept with the map, and a session of short lists is restored as it was."""

from pathlib import Path

import numpy as np
import pytest

from deepsimbad.core.descriptor import ranks_from_ranked_landmarks
from deepsimbad.core.relevance import Query, Relevance
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.core.route import Route
from deepsimbad.engine.active_localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.jobs.build_map import Described, map_contents
from deepsimbad.jobs.stage_results import pack_described, unpack_described
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.map_file import read_map, write_map
from deepsimbad.store.records import DomainRecord

N_IMAGES, N_LANDMARKS = 60, 20


def described(relevance: Relevance) -> Described:
    place = np.random.default_rng(0).normal(size=(N_IMAGES, 4))
    landmarks = np.random.default_rng(1).normal(size=(N_LANDMARKS, 4))
    apart = np.square(place[:, None] - landmarks).sum(axis=2).astype(np.float32)
    return Described(build_retrieval_map(relevance, apart, 3))


def contents_of(found: Described) -> MapContents:
    domain = DomainRecord("d", {}, False, (1.0, 2.0), None, "")
    model = {"prototypes": np.zeros((N_LANDMARKS, 4), np.float32)}
    return map_contents(domain, 1, {}, model, found, Route(np.arange(float(N_IMAGES))))


@pytest.mark.parametrize("relevance", [Relevance.CALIBRATED, Relevance.STANDARDISED])
def test_loadings_outlive_the_process(relevance: Relevance, tmp_path: Path) -> None:
    found = described(relevance)
    assert found.built.statistics is not None
    loadings = found.built.statistics.loadings
    assert loadings is not None
    kept = unpack_described(pack_described(found), np.empty((0, 0), np.float32)).built.statistics
    assert kept is not None
    assert np.array_equal(kept.loadings, loadings)  # type: ignore[arg-type]
    write_map(tmp_path / "map.sqlite", contents_of(found))
    snapshot = MapSnapshot.from_contents(read_map(tmp_path / "map.sqlite"), 0)
    assert snapshot.retrieval.statistics is not None
    assert np.array_equal(snapshot.retrieval.statistics.loadings, loadings)  # type: ignore[arg-type]


def test_a_session_of_short_lists_is_restored_bit_for_bit() -> None:
    snapshot = MapSnapshot.from_contents(contents_of(described(Relevance.CALIBRATED)), 0)
    localizer = ActiveLocalizer(snapshot, LocalizerConfig())
    views = [Query(ranks_from_ranked_landmarks(ids, N_LANDMARKS)) for ids in ([3, 7, 1], [7, 3], [2, 9, 11, 4])]
    state = localizer.start()
    for view in views[:2]:
        state = localizer.step(state, view, 1.0).state
    restored = localizer.from_arrays(localizer.to_arrays(state))
    expected, found = (localizer.step(each, views[2], 1.0).state for each in (state, restored))
    assert expected.relevance is not None
    assert np.array_equal(expected.relevance, found.relevance)  # type: ignore[arg-type]
    assert np.array_equal(expected.belief.mass, found.belief.mass)
