"""kill -9 under load, as `make soak` does it for longer: nothing that was acknowledged is lost, no file is damaged."""

from pathlib import Path

import pytest

from bench.soak.trial import soak


@pytest.mark.slow
def test_a_few_kills(tmp_path: Path) -> None:
    result = soak(tmp_path / "data", n_kills=5, seed=2)
    assert len(result.ready_s) == len(result.empty_ready_s) == 5, "it was ready again every time"
    assert all(result.n_acknowledged[who] for who in ("Robot", "Uploader", "Mapper"))
    assert result.n_remaps >= 1
