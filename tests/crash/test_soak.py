"""After kill -9 under load, as in `make soak` but shorter, nothing acknowledged is lost and no file is damaged."""

from pathlib import Path

import pytest

from bench.measurement import breaches
from bench.soak import trial
from bench.soak.__main__ import limits, report
from bench.soak.actor import LostError, expect
from bench.soak.trial import Soak, soak


@pytest.mark.slow
def test_a_few_kills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "LONGEST_LIFE_S", 1.0)
    result = soak(tmp_path / "data", n_kills=3, seed=2)
    assert len(result.ready_s) == len(result.empty_ready_s) == 3, "it was ready again every time"
    assert all(result.n_acknowledged[actor] for actor in ("Robot", "Uploader", "Mapper"))
    assert result.n_remaps + result.n_interrupted >= 1


def test_one_start_that_takes_too_long_is_told() -> None:
    result = Soak(ready_s=[1.0, 2.5, 1.2], empty_ready_s=[1.0, 2.0, 1.0])
    text = "\n".join(report(result))
    assert "| median 1.20 s, 95 % within 2.37 s, longest 2.50 s |" in text
    assert "| median 1.20 times, 95 % within 1.24 times, longest 1.25 times |" in text
    assert "| right before the longest, on an empty data directory | 2.00 s |" in text
    assert "| 2 | 2.5 | **over** |" in text
    assert breaches(limits(result)) == (
        "over the limit: ready again after a kill, the longest start, seconds: 2.5, at most 2"
    )
    assert breaches(limits(Soak(ready_s=[2.0], empty_ready_s=[1.0]))) is None


def test_a_loss_would_be_seen() -> None:
    with pytest.raises(LostError, match="gone"):
        expect(0, "gone")
