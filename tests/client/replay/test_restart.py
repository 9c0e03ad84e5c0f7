"""A remap is followed while its service is stopped, killed and started again, as a process of its own."""

import threading
from pathlib import Path

import pytest

from deepsimbad_client import Client
from deepsimbad_client.http.jobs import follow_job
from deepsimbad_client.http.local_server import LocalServer
from deepsimbad_client.http.models import Job
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("is_killed", [False, True], ids=["stopped", "killed"])
def test_a_job_is_followed_through_a_restart(tmp_path: Path, encodings: Path, is_killed: bool) -> None:
    heard: list[Job] = []
    has_begun = threading.Event()

    def hear(job: Job) -> None:
        heard.append(job)
        if job.stage is not None:
            has_begun.set()

    with LocalServer(tmp_path / "data") as server, Client(server.url) as client:
        client.admin.put_domain("d", {"kind": "feature_l2", "extractor": "none"})
        for name in ("landmarks", "summer"):
            upload(client, open_source(str(encodings / f"{name}.npy")), "d", name)
        job = client.admin.remap("d", training_traverse="summer", landmark_traverse="landmarks", n_landmarks=50)
        ended: list[Job] = []
        follower = threading.Thread(target=lambda: ended.append(follow_job(client, job.job_id, hear)))
        follower.start()
        try:
            assert has_begun.wait(60), heard
            last = heard[-1]
            if is_killed:
                server.kill()
            else:
                server.stop()
            server.start()
        finally:
            follower.join(240)
        (done,) = ended
    assert done.state == "succeeded"
    assert (done.result or {})["map_version"] in {1, 2}  # a number that was begun is not used again
    assert not last.ended
    assert len(heard) > heard.index(last) + 1
