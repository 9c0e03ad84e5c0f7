"""What the front makes of many answers."""

import warnings

import pytest

pytest.importorskip("ray", reason="the extra `ray` is not installed", exc_type=ImportError)

with warnings.catch_warnings(action="ignore"):  # which are Ray's, of what it uses
    from deepsimbad.fleet.front import added_up


def told(n_requests, n_sessions, ready):
    return f"""# HELP deepsimbad_requests_total Requests.
# TYPE deepsimbad_requests_total counter
deepsimbad_requests_total{{status="200"}} {n_requests}
# HELP deepsimbad_sessions Sessions that have not ended.
# TYPE deepsimbad_sessions gauge
deepsimbad_sessions {n_sessions}
# HELP deepsimbad_ready 1 where /readyz answers 200.
# TYPE deepsimbad_ready gauge
deepsimbad_ready {ready}
"""


def test_counts_are_added_and_what_all_see_alike_is_told_once():
    assert added_up([told(3.0, 0.0, 1.0), told(4.0, 2.0, 1.0), told(5.0, 3.0, 1.0)]) == told(12.0, 5.0, 1.0)
    assert added_up([told(3.0, 0.0, 0.0), told(4.0, 2.0, 1.0)]) == told(7.0, 2.0, 0.0)
