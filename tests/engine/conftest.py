"""A catalog, and maps made without a job."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.core.building import build_map
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import write_map
from deepsimbad.store.sealing import seal

N_IMAGES, N_LANDMARKS, DIM, LIST_LENGTH = 30, 9, 6, 3
EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


def map_contents(
    domain: str = "d", version: int = 1, relevance: Relevance = Relevance.STANDARDISED, closed: bool = False
) -> Map:
    rng = np.random.default_rng(version)
    encodings = rng.normal(size=(N_IMAGES, DIM)).astype(np.float32)
    evaluator = FeatureL2("none")
    model = evaluator.fit_landmarks(rng.normal(size=(N_LANDMARKS, DIM)).astype(np.float32))
    measured = evaluator.dissimilarities(encodings, model)
    drive = Drive(position_m=np.arange(N_IMAGES) * 1.5, encodings=encodings, dissimilarities=measured)
    built = build_map(relevance, drive, LIST_LENGTH, closed)
    return replace(
        built,
        domain=domain,
        version=version,
        created_at="2026-01-01T00:00:00Z",
        evaluator=EVALUATOR,
        actions_m=np.array([1.0, 2.0]),
        landmark_model=model,
        index_bytes=1200,
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
