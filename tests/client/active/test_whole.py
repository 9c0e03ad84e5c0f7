"""The demonstration from end to end, and a robot whose service is restarted under it."""

import threading
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from deepsimbad_client import Client, RetryPolicy
from deepsimbad_client.commands import demo as demonstration
from deepsimbad_client.http.jobs import remap
from deepsimbad_client.http.local_server import LocalServer


@pytest.mark.slow
def test_the_demonstration_on_a_tiny_campus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "RELEVANCES", demonstration.RELEVANCES[-2:])
    ended = CliRunner().invoke(demonstration.demo, [str(tmp_path / "demo"), "--frames", "30"], catch_exceptions=False)
    assert ended.exit_code == 0
    for said in ("calibrated (default)", "It looks and sees", "Move 1: it goes", "constant:10", "8. Pictures:"):
        assert said in ended.stdout
    assert (tmp_path / "demo" / "active" / "belief_by_step.png").exists()


@pytest.mark.slow
def test_a_session_outlives_its_service(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = rng.normal(size=(60, 16)).astype(np.float32)
    with LocalServer(tmp_path / "data") as server, Client(server.url, retry=RetryPolicy(attempts=12)) as client:
        client.admin.put_domain("d", {"kind": "feature_l2", "extractor": "none"})
        client.admin.create_traverse("d", "t")
        client.admin.put_frames("d", "t", encodings=views, index=np.arange(60), position_m=np.arange(60.0))
        remap(client, "d", "t", landmark_traverse="t", n_landmarks=20, training_episodes=0)
        with client.session("d") as session:
            first = session.observe(encoding=views[20])
            assert session.state().belief == first.belief
            server.stop()
            starting = threading.Timer(0.3, server.start)
            starting.start()
            second = session.observe(encoding=views[24], action_m=4)  # knocks until somebody answers
            starting.join()
            assert second.n_observations == 2
            assert second.belief.mode_m == 24
