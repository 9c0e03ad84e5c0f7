"""A catalog in an empty data directory, and small maps."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.store.catalog import Catalog

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(tmp_path / "data") as new_catalog:
        yield new_catalog


@pytest.fixture
def campus(catalog: Catalog) -> Catalog:
    catalog.create_domain("campus", EVALUATOR, False, [1, 2, 3])
    return catalog


@pytest.fixture(scope="session")
def make_map() -> Callable[..., Map]:
    def make(n: int = 60, r: int = 20, h: int = 4, seed: int = 0, **changes: Any) -> Map:
        generator = np.random.default_rng(seed)
        lists = np.argsort(generator.random((n, r)), axis=1)[:, :h].T.astype(np.uint16).copy()
        parts: dict[str, Any] = {
            "domain": "campus",
            "version": 1,
            "created_at": "2025-01-01T00:00:00.000Z",
            "config": {"n_landmarks": r, "list_length": h, "relevance": "standardised"},
            "evaluator": EVALUATOR,
            "closed": False,
            "actions_m": (1.0, 2.0, 3.0),
            "landmark_model": {"prototypes": generator.random((r, 8), dtype=np.float32)},
            "lists": lists,
            "position_m": np.arange(n, dtype=np.float64),
            "statistics": generator.random((2, r)),
            "timestamp_us": np.arange(n) * 200_000,
            "x_m": generator.random(n),
            "y_m": generator.random(n),
            "q_values": generator.random((n, 3), dtype=np.float32),
            "metrics": {"anr": 4.25},
        }
        return Map(**{**parts, **changes})

    return make


@pytest.fixture(scope="session")
def make_frames() -> Callable[..., Drive]:
    def make(index: list[int] | np.ndarray, dim: int = 8, seed: int = 0) -> Drive:
        index = np.asarray(index)
        generator = np.random.default_rng(seed)
        n = len(index)
        return Drive(
            index=index,
            position_m=index * 1.5,
            timestamp_us=index * 1000,
            x_m=generator.normal(size=n),
            y_m=generator.normal(size=n),
            encodings=generator.normal(size=(n, dim)).astype(np.float32),
        )

    return make
