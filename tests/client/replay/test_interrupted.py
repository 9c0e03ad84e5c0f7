"""Uploads that are stopped at an arbitrary place go on there."""

import threading
from pathlib import Path

import pytest

from deepsimbad_client import Client, errors
from deepsimbad_client.http.upload import UploadReport, in_order, upload
from deepsimbad_client.recordings.sources import open_source


def test_an_upload_that_is_stopped_goes_on(service: str, encodings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepsimbad_client.http.upload.BATCH_BYTES", 10 * 32 * 4)
    recording = open_source(str(encodings / "summer.npy"))

    def stop(progress: UploadReport) -> None:
        if progress.n_done >= 50:
            raise KeyboardInterrupt

    with Client(service) as client:
        client.admin.put_domain("halted", {"kind": "feature_l2", "extractor": "none"})
        with pytest.raises(KeyboardInterrupt):
            upload(client, recording, "halted", "t", on_progress=stop)
        report = upload(client, recording, "halted", "t")
        assert (report.n_skipped, report.n_sent) == (50, 70)
        resent = upload(client, recording, "halted", "t", resend=True)
        assert (resent.n_skipped, resent.n_sent) == (0, 120)
        assert client.admin.traverse("halted", "t").n_frames == 120


def test_results_come_in_order_and_work_never_runs_far_ahead() -> None:
    begun: list[int] = []
    release = threading.Event()

    def work(item: int) -> int:
        begun.append(item)
        if item == 0:
            release.wait(10)
        return item * item

    results = in_order(work, range(100), 4)
    release.set()
    assert next(results) == (0, 0)
    assert max(begun) < 8
    assert [result for _, result in results] == [item * item for item in range(1, 100)]


def test_a_failure_comes_in_its_turn_and_stops_the_rest() -> None:
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        if item == 5:
            raise errors.ReplayError("five")
        return item

    results = []
    with pytest.raises(errors.ReplayError, match="five"):
        results.extend(result for _, result in in_order(work, range(1000), 2))
    assert len(begun) < 20
