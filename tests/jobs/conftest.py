"""A catalog with one domain of ready encodings, and drives to put into it and to make maps of."""

import numpy as np
import pytest

from deepsimbad.core.drive import Drive
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map
from deepsimbad.store.traverses import Traverse

DOMAIN = "route"
READY = {"kind": "feature_l2", "extractor": "none"}


@pytest.fixture
def catalog(tmp_path):
    with Catalog.open(tmp_path / "data") as new_catalog:
        new_catalog.create_domain(DOMAIN, READY, False, (1.0, 2.0))
        yield new_catalog


@pytest.fixture(scope="session")
def evaluator():
    return make_evaluator(evaluator_config(READY))


@pytest.fixture
def store(catalog):
    """Stores a traverse of encodings [n, d], a metre a frame unless positions are given."""

    def put(name, encodings, position_m=None, **fields):
        position_m = np.arange(len(encodings)) if position_m is None else position_m
        frames = Drive(position_m=np.asarray(position_m, float), encodings=np.asarray(encodings, np.float32), **fields)
        with Traverse.create(catalog.data_dir, DOMAIN, name) as traverse:
            if frames.n_frames:
                traverse.put_frames(frames)

    return put


@pytest.fixture
def drive(store):
    """Stores a traverse of random encodings, whose frames have names; returns them [n, d]."""

    def put(name, n, seed=0, position_m=None, d=6, **fields):
        encodings = np.random.default_rng(seed).normal(size=(n, d)).astype(np.float32)
        store(name, encodings, position_m, frame_name=np.array([f"{name}{i}.png" for i in range(n)], np.str_), **fields)
        return encodings

    return put


@pytest.fixture
def two_drives(drive):
    """Landmarks and a training drive; returns both their encodings."""
    return drive("other", 30, seed=1), drive("drive", 12)


@pytest.fixture
def run(catalog, evaluator):
    """Makes the next map of a traverse."""

    def make(training, progress=None, job_id=None, **config):
        progress = progress or Progress(REMAP_STAGES)
        return remap(catalog, DOMAIN, RemapConfig(training, **config), evaluator, progress, job_id=job_id)

    return make


@pytest.fixture
def contents(catalog):
    """Reads a version of the map."""
    return lambda version: read_map(catalog.map_path(DOMAIN, version))
