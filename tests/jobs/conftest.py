"""A catalog with one domain of ready encodings, and drives to put into it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.core.frames import UNKNOWN_TIMESTAMP
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import REMAP_STAGES
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.traverses import Traverse

DOMAIN = "route"
READY = {"kind": "feature_l2", "extractor": "none"}


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(tmp_path / "data") as new_catalog:
        new_catalog.create_domain(DOMAIN, READY, False, (1.0, 2.0))
        yield new_catalog


@pytest.fixture(scope="session")
def evaluator() -> Evaluator:
    return make_evaluator(evaluator_config(READY))


@pytest.fixture
def drive(catalog: Catalog) -> Callable[..., np.ndarray]:
    """Stores a traverse of random encodings; returns them [n, d]."""

    def store(name: str, n: int, seed: int = 0, position_m: Any = None, d: int = 6, **fields: Any) -> np.ndarray:
        encodings = np.random.default_rng(seed).normal(size=(n, d)).astype(np.float32)
        frames = Drive(
            index=np.arange(n),
            position_m=np.arange(n, dtype=float) if position_m is None else np.asarray(position_m, float),
            timestamp_us=fields.get("timestamp_us", np.full(n, UNKNOWN_TIMESTAMP)),
            x_m=fields.get("x_m", np.full(n, np.nan)),
            y_m=fields.get("y_m", np.full(n, np.nan)),
            frame_name=np.array([f"{name}{i}.png" for i in range(n)], np.str_),
            encodings=encodings,
        )
        with Traverse.create(catalog.data_dir, DOMAIN, name) as traverse:
            if n:
                traverse.put_frames(frames)
        return encodings

    return store


@pytest.fixture
def quiet() -> Progress:
    return Progress(REMAP_STAGES)
