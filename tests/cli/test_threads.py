"""Threads that compute for a command."""

import os

import pytest

from deepsimbad import __main__, cli


@pytest.mark.parametrize(("value", "timeout"), [(None, "16"), ("26", "26")])
def test_threads_of_products_spin_shortly_unless_told(monkeypatch, value, timeout):
    """The library reads the variable when it is loaded, which the command does after it is set."""
    monkeypatch.setenv("OPENBLAS_THREAD_TIMEOUT", value or "")
    if value is None:
        monkeypatch.delenv("OPENBLAS_THREAD_TIMEOUT")
    monkeypatch.setattr(cli, "run", lambda: 0 if os.environ["OPENBLAS_THREAD_TIMEOUT"] == timeout else 1)
    with pytest.raises(SystemExit) as ending:
        __main__.main()
    assert ending.value.code == 0
