"""A catalog, and maps made without a job."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.core.relevance import Relevance
from deepsimbad.core.retrieval import build_retrieval_map
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import MapContents, write_map
from deepsimbad.store.sealing import seal

N_IMAGES, N_LANDMARKS, DIM, LIST_LENGTH = 30, 9, 6, 3
EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


def map_contents(
    domain: str = "d", version: int = 1, relevance: Relevance = Relevance.STANDARDISED, closed: bool = False
) -> MapContents:
    rng = np.random.default_rng(version)
    encodings = rng.normal(size=(N_IMAGES, DIM)).astype(np.float32)
    evaluator = FeatureL2("none")
    model = evaluator.fit_landmarks(rng.normal(size=(N_LANDMARKS, DIM)).astype(np.float32))
    built = build_retrieval_map(relevance, evaluator.dissimilarities(encodings, model), LIST_LENGTH, encodings)
    statistics, calibration = built.statistics, built.calibration
    return MapContents(
        domain=domain,
        version=version,
        created_at="2026-01-01T00:00:00Z",
        config={"relevance": relevance.value, "n_landmarks": N_LANDMARKS, "list_length": LIST_LENGTH},
        evaluator=EVALUATOR,
        closed=closed,
        actions_m=(1.0, 2.0),
        landmark_model=model,
        lists=built.index.lists,
        values=built.index.values,
        encodings=built.encodings,
        statistics=None if statistics is None else np.stack([statistics.mean, statistics.std]),
        correlation=None if calibration is None else calibration.correlation,
        listed_score=None if calibration is None else calibration.listed_score,
        position_m=np.arange(N_IMAGES) * 1.5,
        timestamp_us=None,
        x_m=None,
        y_m=None,
        q_values=None,
        metrics={},
    )


def add_map(catalog: Catalog, domain: str, relevance: Relevance = Relevance.STANDARDISED, closed: bool = False) -> int:
    """Build and seal the next version; not activated."""
    version = catalog.begin_map(domain, {})
    building = catalog.building_path(domain, version)
    write_map(building, map_contents(domain, version, relevance, closed))
    digest, n_bytes = seal(building, catalog.map_path(domain, version))
    catalog.seal_map(domain, version, digest, n_bytes, {})
    return version


def add_domain(catalog: Catalog, name: str, **more: Any) -> None:
    catalog.create_domain(name, EVALUATOR, more.get("closed", False), (1.0, 2.0))


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(tmp_path) as opened:
        yield opened
