"""The demonstration's verdict on its planners."""

import pytest

from deepsimbad_client.commands.demo import PLANNERS, _verdict

OURS, RANDOM, CONSTANT = PLANNERS


@pytest.mark.parametrize(
    ("anr", "ends", "says"),
    [
        ((1.0, 5.0, 2.0), ([-6, -2], [-2, 0.5]), f"that is more than chance over {RANDOM}."),
        ((3.0, 5.0, 2.0), ([-6, -2], [0.2, 2]), "The default did not win here, and that is more than chance."),
        ((3.0, 5.0, 2.0), ([-6, -2], [-1, 2]), "did not win here, which 10 starts cannot tell from chance."),
        ((None, None, None), (None, None), "No episode could be scored."),
    ],
)
def test_it_says_honestly_which_planner_won(anr, ends, says):
    summary = {
        "anr": dict(zip(PLANNERS, anr, strict=True)),
        "against": {name: {"interval_95": interval} for name, interval in zip((RANDOM, CONSTANT), ends, strict=True)},
        "planner_named": {OURS: "informed", RANDOM: RANDOM, CONSTANT: CONSTANT},
    }
    verdict = _verdict(summary)
    assert verdict.endswith(says)
    if anr[0] is not None:
        assert (f"informed (default), {anr[0]:.2f} %" in verdict) == (anr[0] == min(anr))
