"""Keys in a catalog, and rings of them."""

import time

import pytest

from deepsimbad.api.keys import KeyRing
from deepsimbad.store.catalog import Catalog


@pytest.fixture
def anyio_backend():
    return "asyncio"


@pytest.fixture
def catalog(tmp_path):
    with Catalog.open(tmp_path) as catalog:
        yield catalog


def ring_of(catalog, clock=time.monotonic):
    ring = KeyRing(clock)
    ring.load(catalog.keys)
    return ring
