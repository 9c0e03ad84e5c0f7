"""The demonstration from end to end, and jobs and robots whose service is restarted under them, as a process."""

import os
import shutil
import threading

import numpy as np
import pytest
from click.testing import CliRunner

from deepsimbad_client import Client, RetryPolicy
from deepsimbad_client.commands import demo as demonstration
from deepsimbad_client.http.admin import follow_job
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.models import Job
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from ..conftest import ENCODINGS

pytestmark = pytest.mark.slow


def test_the_demonstration_on_a_tiny_campus(rendered, tmp_path, monkeypatch):
    monkeypatch.setattr(demonstration, "RELEVANCES", demonstration.RELEVANCES[-1:])
    monkeypatch.setattr(demonstration, "EPISODES", 2)
    shutil.copytree(rendered, tmp_path / "demo" / "campus", copy_function=os.link)
    result = CliRunner().invoke(demonstration.demo, [str(tmp_path / "demo"), "--frames", "36"], catch_exceptions=False)
    assert result.exit_code == 0
    for words in ("composed (default)", "It looks and sees", "Move 1: it goes", "constant:10", "8. Pictures:"):
        assert words in result.stdout
    assert (tmp_path / "demo" / "active" / "belief_by_step.png").exists()


@pytest.mark.parametrize("is_killed", [False, True], ids=["stopped", "killed"])
def test_a_job_and_a_session_outlive_their_service(tmp_path, encodings, is_killed):
    heard: list[Job] = []
    has_begun = threading.Event()

    def hear(job):
        heard.append(job)
        if job.stage is not None:
            has_begun.set()

    patience = RetryPolicy(attempts=60)  # a start may take long
    with LocalServer(tmp_path / "data") as server, Client(server.url, retry=patience) as client:
        end = server.kill if is_killed else server.stop
        client.admin.put_domain("d", ENCODINGS)
        for name in ("landmarks", "summer"):
            upload(client, open_source(str(encodings / f"{name}.npy")), "d", name)
        job = client.admin.remap("d", training_traverse="summer", landmark_traverse="landmarks", n_landmarks=50)
        last_jobs: list[Job] = []
        follower = threading.Thread(target=lambda: last_jobs.append(follow_job(client, job.job_id, hear)))
        follower.start()
        try:
            assert has_begun.wait(60), heard
            last = next(job for job in heard if job.stage is not None)
            end()
            server.start()
        finally:
            follower.join(240)
        (last_job,) = last_jobs
        assert last_job.state == "succeeded"
        assert (last_job.result or {})["map_version"] in {1, 2}  # a number that was begun is not used again
        assert not last.ended
        assert len(heard) > heard.index(last) + 1

        views = np.load(encodings / "summer.npy")
        with client.session("d") as session:
            first = session.observe(encoding=views[20])
            end()
            starting = threading.Timer(0.3, server.start)
            starting.start()
            second = session.observe(encoding=views[24], action_m=4)  # knocks until somebody answers
            starting.join()
            assert (first.n_observations, second.n_observations) == (1, 2)
            assert second.belief.mode_m == 24
