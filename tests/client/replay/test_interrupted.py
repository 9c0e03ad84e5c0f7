"""Replays and uploads that are stopped at an arbitrary place go on there."""

import threading
from pathlib import Path

import httpx2
import pytest

from deepsimbad_client import Client, errors
from deepsimbad_client.http.jobs import remap
from deepsimbad_client.http.models import Localization
from deepsimbad_client.http.upload import UploadReport, in_order, upload
from deepsimbad_client.recordings.sources import open_source
from deepsimbad_client.replay import replay
from deepsimbad_client.step_log import Step


def test_a_replay_goes_on_where_it_was_stopped(service: str, encodings: Path, tmp_path: Path) -> None:
    recording = open_source(f"{encodings / 'winter.npy'}#20:60")
    counted: list[str] = []

    def count(request: httpx2.Request) -> None:
        if request.headers["accept"] == "application/octet-stream":
            counted.append(request.url.path)

    with Client(service) as client:
        client._wire.link.http.event_hooks = {"request": [count], "response": []}
        client.admin.put_domain("stopped", {"kind": "feature_l2", "extractor": "none"})
        upload(client, open_source(str(encodings / "summer.npy")), "stopped", "summer")
        remap(client, "stopped", "summer", landmark_traverse="summer", n_landmarks=50)
        whole = replay(client, recording, "stopped", tmp_path / "whole", concurrency=3)
        assert [step.index for step in whole.steps] == list(range(20, 60))
        counted.clear()

        def stop(step: Step, n_done: int) -> None:
            if n_done == 17:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            replay(client, recording, "stopped", tmp_path / "parts", concurrency=3, on_progress=stop)
        assert len((tmp_path / "parts" / "steps.jsonl").read_text().splitlines()) == 17
        counted.clear()
        resumed = replay(client, recording, "stopped", tmp_path / "parts", concurrency=3)
        assert len(counted) == 40 - 17

        def essence(steps: list[Step]) -> list[tuple[object, ...]]:
            return [(step.query, step.name, step.rank, step.best_map_image, step.error_m) for step in steps]

        assert essence(resumed.steps) == essence(whole.steps)
        assert (resumed.heat.values == whole.heat.values).all()
        remap(client, "stopped", "summer")
        with pytest.raises(errors.ReplayError, match="map_version 1, now 2"):
            replay(client, recording, "stopped", tmp_path / "parts")


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


def test_a_domain_without_a_map_cannot_be_replayed_against(service: str, encodings: Path, tmp_path: Path) -> None:
    with Client(service) as client:
        client.admin.put_domain("bare", {"kind": "feature_l2", "extractor": "none"})
        with pytest.raises(errors.ReplayError, match="remap"):
            replay(client, open_source(str(encodings / "winter.npy")), "bare", tmp_path)


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


def test_the_shortlist_of_all_images_is_read_in_map_order() -> None:
    from deepsimbad_client.map_route import map_route_of  # noqa: PLC0415

    answer = Localization.model_validate(
        {
            "map_version": 3,
            "timings_ms": {},
            "belief": {
                "mean_m": 0,
                "mode_m": 0,
                "std_m": 0,
                "credible_95_m": [0, 1],
                "entropy_bits": 0,
                "histogram": {"edges_m": [0, 1], "mass": [1]},
                "top": [
                    {"map_image": 1, "route_position_m": 5, "x_m": 1.0, "y_m": 2.0, "mass": 1},
                    {"map_image": 0, "route_position_m": 0, "x_m": None, "y_m": None, "mass": 0},
                ],
            },
            "retrieval": [
                {"map_image": 1, "route_position_m": 5, "relevance": 9},
                {"map_image": 0, "route_position_m": 0, "relevance": 1},
            ],
        }
    )
    route = map_route_of(answer, closed=False, length_m=5)
    assert route.path.position_m.tolist() == [0, 5]
    assert route.path.x_m[1] == 1.0
    assert route.path.knows_xy
