import os
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.core.frames import MAX_POSITION_M, Camera
from deepsimbad.errors import (
    DamagedFileError,
    DeepSimbadError,
    GreyLevelsDifferError,
    InvalidEncodingError,
    InvalidInputError,
    InvalidRouteError,
    UnavailableError,
    UnknownTraverseError,
    WeightsDifferError,
)
from deepsimbad.store import layout, traverses
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.traverses import Traverse

from .conftest import MakeFrames


@pytest.fixture
def summer(campus: Catalog) -> Iterator[Traverse]:
    with Traverse.create(campus.data_dir, "campus", "summer") as traverse:
        yield traverse


def frame(index: int, encoding: NDArray[np.floating], position_m: float, **fields: Any) -> Drive:
    rows = np.asarray(encoding, np.float32)[np.newaxis]
    return Drive(index=np.array([index]), position_m=np.array([position_m]), encodings=rows, **fields)


def arrays_of(drive: Drive) -> dict[str, np.ndarray]:
    return {name: array for name, array in vars(drive).items() if isinstance(array, np.ndarray)}


def is_equal(left: Drive, right: Drive) -> bool:
    left_arrays, right_arrays = arrays_of(left), arrays_of(right)
    return left.weights_sha256 == right.weights_sha256 and all(
        left_arrays[name].dtype.kind == right_arrays[name].dtype.kind
        and np.array_equal(left_arrays[name], right_arrays[name], equal_nan=left_arrays[name].dtype.kind == "f")
        for name in left_arrays
    )


def test_frames_come_back_exactly_and_in_index_order(
    summer: Traverse, campus: Catalog, make_frames: MakeFrames
) -> None:
    assert (summer.n_frames, summer.encoding_dim, summer.summary().missing) == (0, None, [])
    assert summer.read().encodings.shape == (0, 0)
    frames = make_frames([7, 2, 5, 0])
    frames = replace(
        frames,
        timestamp_us=np.array([1, -1, 2**60, 0]),
        x_m=np.array([np.nan, -0.0, 1e-300, -MAX_POSITION_M]),
        position_m=np.array([-0.0, -3.25, 1e-9, 1 / 3]),
        frame_name=np.array(["7.png", "", "Straße 5.jpg", "\U0001f697"]),
    )
    assert summer.put_frames(frames) == (4, 0)
    order = np.argsort(frames.index)
    expected = Drive(**{name: array[order] for name, array in arrays_of(frames).items()})
    assert is_equal(summer.read(), expected)
    assert (summer.n_frames, summer.encoding_dim) == (4, 8)
    assert summer.summary().missing == [(1, 1), (3, 4), (6, 6)]
    summer.close()
    with Traverse.open(campus.data_dir, "campus", "summer") as again:
        assert is_equal(again.read(), expected)


def test_one_frame_is_new_once_and_then_replaced(summer: Traverse) -> None:
    fields = {"timestamp_us": np.array([10]), "x_m": np.array([0.5])}
    assert summer.put_frames(frame(3, np.arange(4), 1.5, **fields)) == (1, 0)
    assert summer.put_frames(frame(3, np.ones(4), 2.5)) == (0, 1)
    frames = summer.read()
    assert frames.n_frames == summer.n_frames == 1
    assert frames.encodings.tolist() == [[1, 1, 1, 1]]
    assert (frames.position_m[0], frames.timestamp_us[0]) == (2.5, -1)
    assert np.isnan(frames.x_m[0])
    assert np.isnan(frames.y_m[0])


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"index": np.array([0, 1, 2**62])}, InvalidInputError),
        ({"position_m": np.array([0, np.inf, 1])}, InvalidRouteError),
        ({"position_m": np.array(["a", "b", "c"])}, InvalidInputError),
        ({"frame_name": np.array(["a", "b\n", "c"])}, InvalidInputError),
        ({"frame_name": np.array(["a", "\ud800", "c"])}, InvalidInputError),
        ({"frame_name": np.array([65, 0x110000, 67], np.uint32).view("<U1")}, InvalidInputError),
        ({"encodings": np.full((3, 8), np.inf, np.float32)}, InvalidEncodingError),
        ({"encodings": np.ones((3, 0), np.float32)}, InvalidEncodingError),
        ({"encodings": np.ones(3, np.float32)}, InvalidEncodingError),
    ],
)
def test_bad_frames_change_nothing(
    summer: Traverse, make_frames: MakeFrames, change: dict[str, np.ndarray], error: type[DeepSimbadError]
) -> None:
    summer.put_frames(make_frames([0, 5]))
    old_drive = summer.read()
    with pytest.raises(error):
        summer.put_frames(replace(make_frames([0, 1, 2], seed=1), **change))
    assert is_equal(summer.read(), old_drive)


def test_a_deleted_traverse_takes_no_more_frames(summer: Traverse, campus: Catalog, make_frames: MakeFrames) -> None:
    summer.put_frames(make_frames([0]))
    Traverse.delete(campus.data_dir, "campus", "summer")
    with pytest.raises(UnknownTraverseError):
        summer.put_frames(make_frames([1]))
    with Traverse.create(campus.data_dir, "campus", "summer") as anew:
        assert anew.n_frames == 0
        with pytest.raises(UnknownTraverseError):
            summer.put_frames(make_frames([1]))
        assert anew.n_frames == 0


def test_one_that_is_deleted_while_it_is_opened_is_unknown(
    summer: Traverse, campus: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    opening = traverses.open_working_file

    def too_late(*arguments: Any, **options: Any) -> Any:
        Traverse.delete(campus.data_dir, "campus", summer.name)
        return opening(*arguments, **options)

    monkeypatch.setattr(traverses, "open_working_file", too_late)
    with pytest.raises(UnknownTraverseError):
        Traverse.open(campus.data_dir, "campus", summer.name)


def test_a_stale_log_is_not_replayed_into_a_new_traverse(campus: Catalog, make_frames: MakeFrames) -> None:
    folder = campus.data_dir / "domains/campus/traverses"
    with Traverse.create(campus.data_dir, "campus", "summer") as old:
        old.put_frames(make_frames(range(50)))
        log = (folder / "summer.sqlite-wal").read_bytes()
    assert len(log) > 1000
    (folder / "summer.sqlite").unlink()  # a deletion that was cut short: the file is gone, its log is not
    (folder / "summer.sqlite-wal").write_bytes(log)
    (folder / "summer.new").write_bytes(b"half made")
    with Traverse.create(campus.data_dir, "campus", "summer") as new:
        assert new.n_frames == 0
        assert new.put_frames(make_frames(range(3))) == (3, 0)


def test_a_truncated_or_foreign_file_is_named_and_can_be_deleted(campus: Catalog, make_frames: MakeFrames) -> None:
    path = campus.data_dir / "domains/campus/traverses/summer.sqlite"
    with Traverse.create(campus.data_dir, "campus", "summer") as traverse:
        traverse.put_frames(make_frames(range(400)))
    traverse_bytes = path.read_bytes()

    def read() -> None:
        with Traverse.open(campus.data_dir, "campus", "summer") as traverse:
            traverse.read()

    catalog_bytes = (campus.data_dir / "catalog.sqlite").read_bytes()
    for content in (
        b"",
        traverse_bytes[:100],
        traverse_bytes[:4096],
        traverse_bytes[: len(traverse_bytes) // 2],
        b"no database" * 1000,
        catalog_bytes,
    ):
        path.write_bytes(content)
        with pytest.raises(DamagedFileError, match="summer"):
            read()
    Traverse.delete(campus.data_dir, "campus", "summer")
    assert Traverse.list(campus.data_dir, "campus") == []


def test_uploading_and_reading_hold_little_beside_the_one_array(summer: Traverse, make_frames: MakeFrames) -> None:
    frames = make_frames(range(16_384), dim=256)
    tracemalloc.start()
    summer.put_frames(frames, replace=False)
    _, put_peak = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    n_bytes_before, _ = tracemalloc.get_traced_memory()
    back = summer.read()
    _, read_peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    n_bytes = frames.encodings.nbytes
    assert put_peak < 0.25 * n_bytes
    assert n_bytes < read_peak - n_bytes_before < 1.25 * n_bytes
    assert np.array_equal(back.encodings, frames.encodings)


def test_what_frames_show_is_stored_with_them_and_levels_with_the_frame_that_gave_them(
    summer: Traverse, make_frames: MakeFrames
) -> None:
    frames = replace(make_frames(range(3)), shows_nothing=np.array([False, True, True]))
    summer.put_frames(frames)
    assert summer.summary().n_uninformative == 2
    assert summer.read().shows_nothing.tolist() == [False, True, True]
    summer.put_frames(make_frames([1]))  # replaced by one that does show something
    with pytest.raises(InvalidEncodingError):
        summer.put_frames(replace(make_frames([5], dim=3), grey_levels=(0, 1023)))
    assert (summer.summary().n_uninformative, summer.grey_levels) == (1, None)
    assert summer.summary().warnings == ("1 of 3 pictures show nothing: one grey, noise or the dark",)
    summer.put_frames(replace(make_frames([5]), grey_levels=(0, 4095)))
    with pytest.raises(GreyLevelsDifferError):
        summer.put_frames(replace(make_frames([6]), grey_levels=(0, 1023)))
    assert (summer.n_frames, summer.grey_levels) == (4, (0, 4095))


def test_frames_are_counted_that_are_written_over_what_the_log_held_before(
    summer: Traverse, campus: Catalog, make_frames: MakeFrames
) -> None:
    summer.put_frames(make_frames(range(50)))
    summer._db.conn.execute("PRAGMA wal_checkpoint")  # the next write begins the log anew, which stays as long
    log = layout.traverse_path(campus.data_dir, "campus", "summer").with_suffix(".sqlite-wal")
    os.utime(log, (0, 0))
    n_bytes = log.stat().st_size
    assert summer.summary().n_uninformative == 0
    summer.put_frames(frame(50, make_frames([50]).encodings[0], 99.0, shows_nothing=np.array([True])))
    assert (summer.summary().n_uninformative, log.stat().st_size) == (1, n_bytes)


def test_the_camera_of_an_unchanged_traverse_is_read_once(campus: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    location = (campus.data_dir, "campus", "summer")
    with Traverse.create(*location) as summer:
        assert Traverse.main_camera(*location) is None
        summer.put_frames(frame(0, np.ones(4), 0.0, camera=Camera(40, 30)))
        assert Traverse.main_camera(*location) == Camera(40, 30)
    assert Traverse.main_camera(*location) == Camera(40, 30)  # the file was closed meanwhile
    monkeypatch.setattr(Traverse, "open", None)
    assert Traverse.main_camera(*location) == Camera(40, 30)
    with pytest.raises(UnknownTraverseError):
        Traverse.main_camera(campus.data_dir, "campus", "winter")


def test_the_weights_of_the_first_image_hold_for_all(summer: Traverse, make_frames: MakeFrames) -> None:
    summer.put_frames(make_frames(range(2)))  # ready encodings: nobody knows whose
    assert summer.read().weights_sha256 is None
    summer.put_frames(replace(make_frames(range(2, 4)), weights_sha256="a" * 64))
    with pytest.raises(WeightsDifferError) as caught:
        summer.put_frames(replace(make_frames(range(4, 6)), weights_sha256="b" * 64))
    assert caught.value.hints == {"known_weights_sha256": "a" * 64, "given_weights_sha256": "b" * 64}
    summer.put_frames(make_frames(range(4, 5)))
    frames = summer.read()
    assert (frames.n_frames, frames.weights_sha256) == (5, "a" * 64)


def test_encodings_take_half_the_bytes_where_nothing_is_lost(summer: Traverse, make_frames: MakeFrames) -> None:
    frames = make_frames(range(3))
    rounded = frames.encodings.astype(np.float16).astype(np.float32)
    rounded[2, 0] = 1e6  # beyond float16
    summer.put_frames(replace(frames, encodings=rounded))
    np.testing.assert_array_equal(summer.read().encodings, rounded)
    sizes = [row["n"] for row in summer._db.query("SELECT length(body) AS n FROM encoding ORDER BY frame_index")]
    assert sizes == [2 * rounded.shape[1]] * 2 + [4 * rounded.shape[1]]


def test_a_disk_that_fills_while_pictures_wait_is_named_and_leaves_all_as_it_was(
    summer: Traverse, make_frames: MakeFrames
) -> None:
    summer.put_frames(make_frames([0, 1, 2]), pictures={0: b"waits"})
    (n_pages,) = summer._db.conn.execute("PRAGMA page_count").fetchone()
    summer._db.conn.execute(f"PRAGMA max_page_count = {n_pages}")
    dim, new_frames = summer.read().encoding_dim, make_frames([3])
    for _ in range(2):
        with pytest.raises(UnavailableError) as full:
            summer.put_frames(new_frames, pictures={3: bytes(1 << 20)})
        assert full.value.hints["reason"] == "disk_full"
    with pytest.raises(UnavailableError):
        summer.keep_views({0: np.zeros((4096, dim), np.float32)})
    summary = summer.summary()
    assert (summary.n_frames, summary.n_spooled, summary.spooled_bytes) == (3, 1, 5)
    assert (summer.picture(0), summer.views(0, dim)) == (b"waits", None)
    summer._db.conn.execute("PRAGMA max_page_count = 1000000")
    assert summer.put_frames(new_frames, pictures={3: bytes(1 << 20)}) == (1, 0)


def test_frames_unlike_all_others_are_counted_beside_those_whose_pictures_show_nothing(
    summer: Traverse, make_frames: MakeFrames
) -> None:
    frames = make_frames(range(200), dim=64)
    frames.encodings[150:153] += 9 * frames.encodings.std(axis=0)  # glare
    blank = np.zeros(200, np.bool_)
    blank[[3, 151]] = True
    summer.put_frames(replace(frames, shows_nothing=blank))
    summary = summer.summary()
    assert summary.n_uninformative == 4 == (summer.read().shows_nothing | summer.read().is_unlike_all).sum()
    assert summary.warnings == (
        "2 of 200 pictures show nothing: one grey, noise or the dark",
        "2 of 200 pictures are so unlike all others that they may show nothing of the route: glare, or the dark",
    )
    summer.put_frames(make_frames([150, 151, 152], dim=64))  # taken again
    assert summer.summary().n_uninformative == 1
