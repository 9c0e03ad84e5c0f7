"""`deepsimbad ray map`: encoded by a cluster, the same file as one machine makes; what was encoded is kept."""

import os
import shutil
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepsimbad.cli import run
from deepsimbad.errors import CancelledError, UnavailableError
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs import versions
from deepsimbad.store.catalog import Catalog
from deepsimbad_client.recordings.folder import read_folder
from tests.store.bucket import BUCKET, served_bucket

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'deep-simbad[ray]'")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Ray's own
N_FRAMES = 60

from deepsimbad.fleet import drives  # noqa: E402 - takes Ray
from deepsimbad.fleet.drives import stored_drive  # noqa: E402


@pytest.fixture(scope="module", autouse=True)
def _cluster() -> Iterator[None]:
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
    is_ours = not ray.is_initialized()
    if is_ours:
        ray.init(
            num_cpus=2,
            include_dashboard=False,
            object_store_memory=100_000_000,
            log_to_driver=False,
            logging_level="ERROR",
        )
    yield
    if is_ours:
        ray.shutdown()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of images, two of which cannot be read, and one shows nothing."""
    folder = tmp_path_factory.mktemp("drive")
    for number in range(N_FRAMES):
        coarse = np.random.default_rng(number).integers(0, 255, (6, 8, 3), np.uint8)
        image = cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number:03}.png"), np.full_like(image, 128) if number == 20 else image)
    for broken in (7, 33):
        (folder / f"{broken:03}.png").write_bytes(b"no image")
    return folder


@pytest.fixture
def packs(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(drives, "_FRAMES_A_PACK", 8)
    return 8


def encoded_blocks(drive: Path, folder: Path, on_progress: Any, kind: str = "gradient_grid") -> list[Any]:
    configuration = evaluator_config({"kind": "feature_l2", "extractor": kind})
    evaluator = make_evaluator(configuration, Compute())
    recording = read_folder(drive, 1.0)
    arguments = (recording, evaluator, dict(configuration.as_dict()), Compute(), 50_000_000)
    return list(drives.cluster_blocks(*arguments, folder, on_progress))


class Noon(datetime):
    """The clock of a map's making, which it tells."""

    @classmethod
    def now(cls, tz: Any = None) -> datetime:
        return datetime(2026, 1, 1, 12, tzinfo=tz)


@pytest.mark.parametrize("extractor", ["gradient_grid", "efficientnet_lite0"])
def test_the_map_is_the_one_that_one_machine_makes(
    drive: Path, packs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extractor: str
) -> None:
    monkeypatch.setattr(versions, "datetime", Noon)
    monkeypatch.chdir(tmp_path)
    options = ["--training", str(drive), "--n-landmarks", "20", "--training-episodes", "50", "--evaluator"]
    options += [f"feature_l2:{extractor}"]
    assert run(["map", "route", *options, "--data-dir", "one"]) == 0
    assert run(["ray", "map", "route", *options, "--data-dir", "many"]) == 0
    digests = []
    for data_dir in ("one", "many"):
        with Catalog.open(Path(data_dir)) as catalog:
            digests.append(catalog.map("route", 1).sha256)
            assert catalog.map("route", 1).metrics["n_map_images"] == N_FRAMES - 2
    assert digests[0] == digests[1]
    assert not Path("many/domains/route/encoding").exists()


def test_a_drive_in_an_object_store_is_copied_and_makes_the_same_map(
    drive: Path, packs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(versions, "datetime", Noon)
    options = ["--n-landmarks", "20", "--training-episodes", "0", "--evaluator", "feature_l2:gradient_grid"]
    assert run(["map", "route", "--training", f"{drive}#5:", *options, "--data-dir", "one"]) == 0
    with served_bucket(tmp_path) as bucket:
        for name, value in bucket.environment.items():
            monkeypatch.setenv(name, value)
        url = f"s3://{BUCKET}/drives/{drive.name}"
        many = ["ray", "map", "route", *options, "--data-dir", "many", "--training"]
        assert run([*many, f"{url}#5:"]) == 1
        assert "no objects" in capsys.readouterr().err
        shutil.copytree(drive, bucket.folder / "drives" / drive.name)
        monkeypatch.setattr(drives, "cluster_blocks", lambda *_: pytest.fail("killed"))
        with pytest.raises(pytest.fail.Exception):
            run([*many, f"{url}#5:"])
        monkeypatch.undo()
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(versions, "datetime", Noon)
        for name, value in bucket.environment.items():
            monkeypatch.setenv(name, value)
        bucket.requests.clear()
        copy = next(Path("many/copied-drives").glob(f"*/{drive.name}"))
        (copy / "031.png").unlink()
        os.utime(copy / "032.png", (1, 1))
        assert run([*many, f"{url}#5:"]) == 0
        requests = [request for request in bucket.requests if ".png" in request]
        assert sorted(request.rpartition("/")[2] for request in requests) == ["031.png", "032.png"]
        contents = []
        for data_dir in ("one", "many"):
            with Catalog.open(Path(data_dir)) as catalog:
                contents.append(catalog.map_path("route", 1).read_bytes())
        assert contents[0] == contents[1], "nothing in it tells where the images were"
        assert not copy.exists()
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "stranger")
        assert run([*many, url]) == 1
        assert "credentials" in capsys.readouterr().err


def test_who_lacks_an_image_of_a_stored_drive_copies_it(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served_bucket(tmp_path) as bucket:
        for name, value in bucket.environment.items():
            monkeypatch.setenv(name, value)
        shutil.copytree(drive, bucket.folder / "drives" / "seen")
        stored, part = stored_drive(f"s3://{BUCKET}/drives/seen/#1:9", tmp_path / "copies")
        assert (stored.folder.name, part) == ("seen", "#1:9")
        stored.copy(lambda _: None)
        recording = stored.of(read_folder(stored.folder, 1.0))
        stamps = [recording.stamp(frame) for frame in recording.frames]
        shutil.rmtree(stored.folder)
        assert [recording.stamp(frame) for frame in recording.frames] == stamps
        shutil.rmtree(stored.folder)
        assert recording.image(recording.frames[3], None).body == (drive / "003.png").read_bytes()
    assert stored_drive(str(drive), tmp_path) is None


def test_what_was_encoded_before_a_kill_is_not_encoded_again(drive: Path, packs: int, tmp_path: Path) -> None:
    def stop(share: float) -> None:
        if share >= 0.5:
            raise CancelledError("killed")

    with pytest.raises(CancelledError):
        encoded_blocks(drive, tmp_path, stop)
    files = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*.npz")}
    assert N_FRAMES // packs // 2 <= len(files) < N_FRAMES // packs
    shares: list[float] = []
    blocks = encoded_blocks(drive, tmp_path, shares.append)
    assert shares[0] >= 0.5
    assert shares[-1] == 1
    assert {path: path.stat().st_mtime_ns for path in files} == files
    places = [place for block in blocks for place in block.places.tolist()]
    assert places == [place for place in range(N_FRAMES) if place not in {7, 33}]
    assert [place for block in blocks for place in block.broken] == [7, 33]
    assert sum(block.shows_nothing.sum() for block in blocks) == 1
    later_shares: list[float] = []
    encoded_blocks(drive, tmp_path, later_shares.append)
    assert later_shares == [], "nothing is asked of the cluster"
    image = drive / "050.png"
    os.utime(image, ns=(1, 1))
    encoded_blocks(drive, tmp_path, later_shares.append)
    assert len(later_shares) == 2, "one pack, whose image is another now"


def test_a_worker_that_does_not_reach_the_drive_is_named(
    drive: Path, packs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Unreached(drives._Encoder):
        def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
            raise RuntimeError("no such folder")

    monkeypatch.setattr(drives, "_Encoder", Unreached)
    with pytest.raises(UnavailableError, match="could not be encoded elsewhere"):
        encoded_blocks(drive, tmp_path, lambda _: None)
