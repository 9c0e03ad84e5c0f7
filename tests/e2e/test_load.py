"""Robots, remaps and rollbacks at once, as `make load` does it for an hour: no error, nothing that piles up."""

from pathlib import Path

import pytest

from bench.load import N_ROBOTS, load


@pytest.mark.slow
def test_seconds_under_load(tmp_path: Path) -> None:
    result = load(tmp_path / "data", seconds=6.0, observe_every_s=0.3, remap_every_s=1.0, episodes=200)
    assert result.errors == []
    assert result.n_remaps >= 1
    assert result.n_rollbacks >= 1
    assert len(result.observation_s) > 2 * N_ROBOTS
    second, last = result.quarter(1), result.quarter(3)
    assert last.n_handles <= second.n_handles + 10
    assert last.rss_mb <= 1.2 * second.rss_mb + 20
