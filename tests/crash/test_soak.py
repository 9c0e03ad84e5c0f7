"""kill -9 under load, as `make soak` does it for longer: nothing that was acknowledged is lost, no file is damaged."""

from pathlib import Path

import pytest

from bench.soak.actor import LostError, expect
from bench.soak.trial import soak

READY_WITHIN_S = 2.0


def test_a_few_kills(tmp_path: Path) -> None:
    found = soak(tmp_path / "data", n_kills=3, seed=1)
    assert found.n_kills == 3
    assert all(found.n_acknowledged[who] for who in ("Robot", "Uploader", "Mapper"))


@pytest.mark.slow
def test_many_kills(tmp_path: Path) -> None:
    found = soak(tmp_path / "data", n_kills=10, seed=2)
    assert found.n_remaps >= 1
    # The least of all: others may be using the machine, and a start is no faster for luck.
    assert min(found.ready_s) <= READY_WITHIN_S


def test_a_loss_would_be_seen() -> None:
    with pytest.raises(LostError, match="gone"):
        expect(0, "gone")
