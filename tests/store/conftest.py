"""A catalog in an empty data directory, small maps and drives, and acts that begin at one moment."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import seal, write_map
from deepsimbad.store.records import MapRecord

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}
MakeMap = Callable[..., Map]
MakeFrames = Callable[..., Drive]
AddMap = Callable[..., MapRecord]
Answer = TypeVar("Answer")


def at_once(acts: Sequence[Callable[[], Answer]]) -> list[Answer]:
    """What acts return that all begin at one moment, each in a thread of its own; raises what one of them raises."""
    start = threading.Barrier(len(acts))

    def run(act: Callable[[], Answer]) -> Answer:
        start.wait()
        return act()

    with ThreadPoolExecutor(len(acts)) as threads:
        return list(threads.map(run, acts))


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(tmp_path / "data") as new_catalog:
        yield new_catalog


@pytest.fixture
def campus(catalog: Catalog) -> Catalog:
    catalog.create_domain("campus", EVALUATOR, False, [1, 2, 3])
    return catalog


@pytest.fixture(scope="session")
def make_map() -> MakeMap:
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
def add_map(make_map: MakeMap) -> AddMap:
    def add(catalog: Catalog, domain: str = "campus", seed: int = 0) -> MapRecord:
        version = catalog.begin_map(domain, {"seed": seed})
        building = catalog.building_path(domain, version)
        write_map(building, make_map(version=version, seed=seed, domain=domain))
        digest, n_bytes = seal(building, catalog.map_path(domain, version))
        return catalog.seal_map(domain, version, digest, n_bytes, {"anr": 4.25})

    return add


@pytest.fixture(scope="session")
def make_frames() -> MakeFrames:
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
