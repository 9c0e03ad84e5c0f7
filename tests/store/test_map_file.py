import sqlite3
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from sqlite_utils import Migrations

from deepsimbad.core.map import Map
from deepsimbad.errors import (
    CancelledError,
    DamagedMapError,
    InvalidInputError,
    InvalidMapConfigError,
    UnavailableError,
)
from deepsimbad.store import arrays, map_file
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import _fitting_page_size, index_bytes, read_map, seal, table_bytes, write_map

MakeMap = Callable[..., Map]


def same(left: Map, right: Map) -> bool:
    for each in fields(Map):
        if each.name == "index_bytes":
            continue
        one, two = getattr(left, each.name), getattr(right, each.name)
        if each.name == "q_values":
            if not _same_experience(one, two):
                return False
        elif each.name == "landmark_model":
            if one.keys() != two.keys() or not all(_same_array(one[name], two[name]) for name in one):
                return False
        elif isinstance(one, np.ndarray):
            if not _same_array(one, two):
                return False
        elif one != two:
            return False
    return True


def _same_array(one: np.ndarray, two: np.ndarray) -> bool:
    return two is not None and one.dtype == two.dtype and np.array_equal(one, two, equal_nan=True)


def _same_experience(one: np.ndarray | None, two: np.ndarray | None) -> bool:
    """To half of one of 65,535 steps from the lowest to the highest."""
    if one is None or two is None:
        return one is two
    step = (float(one.max()) - float(one.min())) / 65_535
    return one.shape == two.shape and two.dtype == np.float32 and np.abs(one - two).max() <= step


def everything(make_map: MakeMap) -> Map:
    generator = np.random.default_rng(1)
    return make_map(
        closed=True,
        values=generator.random((4, 60), dtype=np.float32),
        encodings=generator.random((60, 8), dtype=np.float32),
        frame_digest=generator.integers(2**64, size=60, dtype=np.uint64),
        x_m=np.where(np.arange(60) % 7 == 0, np.nan, 1.0),
        landmark_model={
            "prototypes": generator.random((20, 8), dtype=np.float32),
            "big_endian": np.arange(5, dtype=">i4"),
            "scalar": np.float64(2.5),
            "empty": np.zeros((0, 3), np.float32),
            "fortran": np.asfortranarray(generator.random((3, 4))),
        },
    )


def test_a_map_comes_back_exactly_and_frozen(make_map: MakeMap, tmp_path: Path) -> None:
    path = tmp_path / "000001.building"
    bare = make_map(config={"n_landmarks": 20, "relevance": "rrf"}, statistics=None, q_values=None, x_m=None)
    for contents in (everything(make_map), make_map(n=1, r=4), bare):
        write_map(path, contents)
        back = read_map(path)
        little_endian = {
            name: np.asarray(array, np.asarray(array).dtype.newbyteorder("<"))
            for name, array in contents.landmark_model.items()
        }
        assert same(replace(contents, landmark_model=little_endian), back)
        assert (back.n_landmarks, back.list_length, back.n_images) == (
            contents.config["n_landmarks"],
            4,
            contents.lists.shape[1],
        )
        for array in (back.lists, back.position_m, *back.landmark_model.values()):
            assert not array.flags.writeable


def test_an_array_of_many_parts(make_map: MakeMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "PART_BYTES", 100)
    contents = everything(make_map)
    write_map(tmp_path / "map", contents)
    with sqlite3.connect(tmp_path / "map") as connection:
        (n_parts,) = connection.execute("SELECT count(*) FROM map_image_encoding").fetchone()
    connection.close()
    assert n_parts == -(-60 * 8 * 4 // 100)
    monkeypatch.undo()
    back = read_map(tmp_path / "map")
    assert np.array_equal(back.encodings, contents.encodings)
    assert np.array_equal(back.landmark_model["prototypes"], contents.landmark_model["prototypes"])


def test_the_experience_database_takes_two_bytes_a_value_and_loses_nothing_twice(
    make_map: MakeMap, tmp_path: Path
) -> None:
    n = 26_208
    generator = np.random.default_rng(0)
    learnt = (1e-4 + 950 * generator.random((n, 10))).astype(np.float32)
    actions_m = tuple(float(m) for m in range(1, 11))
    write_map(tmp_path / "once", make_map(n=n, r=500, q_values=learnt, actions_m=actions_m))
    once = read_map(tmp_path / "once")
    assert once.q_values is not None
    assert np.abs(once.q_values - learnt).max() < 0.008
    assert table_bytes(tmp_path / "once")["q_value"] / n <= 21
    write_map(tmp_path / "twice", once)
    twice = read_map(tmp_path / "twice")
    assert np.array_equal(once.q_values, twice.q_values)
    flat = np.full((n, 10), 1e-4, np.float32)
    write_map(tmp_path / "flat", make_map(n=n, r=500, q_values=flat, actions_m=actions_m))
    assert np.array_equal(read_map(tmp_path / "flat").q_values, flat)
    with pytest.raises(InvalidInputError, match="NaN"):
        write_map(tmp_path / "nan", make_map(q_values=np.full((60, 3), np.nan, np.float32)))


@pytest.mark.parametrize(
    "change",
    [
        {"config": {}},
        {"config": {"n_landmarks": 3}},
        {"lists": np.zeros((0, 60), np.uint16)},
        {"lists": np.zeros((4, 60), np.int64)},
        {"lists": np.full((4, 60), 20, np.uint16)},
        {"position_m": np.zeros(59)},
        {"position_m": np.zeros(60, np.float32)},
        {"statistics": np.zeros((2, 19))},
        {"values": np.zeros((60, 4), np.float32)},
        {"encodings": np.zeros((59, 8), np.float32)},
        {"q_values": np.zeros((60, 2), np.float32)},
        {"timestamp_us": np.zeros(60)},
    ],
)
def test_parts_that_do_not_fit_are_refused(make_map: MakeMap, change: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(InvalidMapConfigError):
        write_map(tmp_path / "map", make_map(**change))
    assert list(tmp_path.iterdir()) == []


def test_a_failed_or_cancelled_write_leaves_nothing(make_map: MakeMap, tmp_path: Path) -> None:
    path = tmp_path / "map"
    with pytest.raises(InvalidInputError, match="numbers"):
        write_map(path, make_map(landmark_model={"words": np.array(["a"])}))
    seen: list[float] = []

    def cancel(progress: float) -> None:
        seen.append(progress)
        if progress > 0.5:
            raise CancelledError("asked to stop")

    with pytest.raises(CancelledError):
        write_map(path, make_map(), cancel)
    assert seen == sorted(seen)
    with pytest.raises(UnavailableError):
        write_map(tmp_path / "no folder" / "map", make_map())
    assert list(tmp_path.iterdir()) == []
    write_map(path, make_map(), seen.append)
    assert seen[-1] == 1.0


def test_every_flipped_byte_is_seen_or_harmless(make_map: MakeMap, tmp_path: Path) -> None:
    path = tmp_path / "map"
    expected = everything(make_map)
    expected = replace(expected, landmark_model={"prototypes": expected.landmark_model["prototypes"]})
    write_map(path, expected)
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    posting = expected.position_m.tobytes()
    places = [*range(0, 100, 2), whole.index(posting) + 3, *generator.integers(0, len(whole), 400).tolist()]
    n_seen = 0
    for at in places:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << int(generator.integers(8)))]) + whole[at + 1 :])
        try:
            assert same(expected, read_map(path)), f"byte {at} changed what was read"
            table_bytes(path)
        except (DamagedMapError, UnavailableError):
            n_seen += 1
    assert n_seen > 60


def test_files_that_are_no_maps_are_damaged_maps(make_map: MakeMap, tmp_path: Path) -> None:
    path = tmp_path / "map"
    with pytest.raises(DamagedMapError, match="missing"):
        read_map(path)
    write_map(path, make_map())
    whole = path.read_bytes()
    with Catalog.open(tmp_path / "data"):
        pass
    foreign = (tmp_path / "data/catalog.sqlite").read_bytes()
    unmarked = tmp_path / "foreign"
    with sqlite3.connect(unmarked) as connection:
        connection.execute("CREATE TABLE map (id)")
    connection.close()
    contents = [b"", b"x", b"GIF89a" * 1000, whole[:99], foreign, unmarked.read_bytes()]
    contents += [whole[:length] for length in range(4096, len(whole), 4096)]
    for content in contents:
        path.write_bytes(content)
        for read in (read_map, index_bytes):
            if read is index_bytes and content[:99] == whole[:99]:
                continue  # page counts of a file that lost its end may still stand
            with pytest.raises(DamagedMapError):
                read(path)


def _alter(path: Path, *statements: str) -> None:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO _sqlite_migrations (migration_set, name) VALUES ('deepsimbad_map', 'm999_future')",
        "DELETE FROM map",
        "DELETE FROM posting WHERE landmark = 3 AND rank = 1",
        "UPDATE posting SET rank = 9 WHERE landmark = 3 AND rank = 1",
        "UPDATE posting SET image_ids = zeroblob(5) WHERE landmark = 3",
        "UPDATE map SET n_map_images = 1000000000000",
        "UPDATE map SET config = '{'",
        "UPDATE map SET config = '{}'",
        "UPDATE route SET shape = '[1000000000000000]'",
        "UPDATE route SET dtype = 'O'",
        "UPDATE route SET dtype = 'no such'",
        "UPDATE route SET name = 'unheard_of' WHERE name = 'x_m'",
        "DELETE FROM route WHERE name = 'position_m'",
        "DROP TABLE q_value",
        "DELETE FROM q_value",
        "UPDATE q_value SET step = NULL",
        "UPDATE q_value SET step = 2.0 * step",
        "UPDATE q_value SET body = zeroblob(40)",
        "UPDATE q_value SET shape = '[6000000000, 3]'",
        "INSERT INTO q_value SELECT 1, name, dtype, shape, lowest, step, body FROM q_value",
        "PRAGMA journal_mode = WAL",
    ],
)
def test_altered_maps_are_damaged_maps(make_map: MakeMap, statement: str, tmp_path: Path) -> None:
    path = tmp_path / "map"
    write_map(path, make_map())
    _alter(path, statement)
    with pytest.raises(DamagedMapError):
        read_map(path)


def test_a_wrong_checksum_alone_is_seen(make_map: MakeMap, tmp_path: Path) -> None:
    path = tmp_path / "map"
    write_map(path, make_map())
    _alter(path, "UPDATE map SET metrics = '{\"anr\":0.0}'")
    with pytest.raises(DamagedMapError, match="checksum"):
        read_map(path)


def test_an_older_map_is_read_without_touching_its_file(
    make_map: MakeMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map"
    write_map(path, make_map())
    before = path.read_bytes()
    tomorrow = Migrations(map_file.migrations.name)
    tomorrow._migrations = list(map_file.migrations._migrations)
    ran: list[bool] = []

    @tomorrow()
    def m002_tomorrow(db: object) -> None:
        ran.append(True)

    monkeypatch.setattr(map_file, "migrations", tomorrow)
    assert same(make_map(), read_map(path))
    assert ran == [True]
    assert path.read_bytes() == before


def test_names_of_arrays_are_parameters(make_map: MakeMap, tmp_path: Path) -> None:
    name = "x'); DROP TABLE posting; --"
    write_map(tmp_path / "map", make_map(landmark_model={name: np.arange(3)}))
    assert read_map(tmp_path / "map").landmark_model[name].tolist() == [0, 1, 2]


def _with_runs(generator: np.random.Generator, n: int, r: int, h: int, keep: float) -> np.ndarray:
    """Lists in which neighbours share most landmarks, as images along a route do."""
    lists = np.empty((h, n), np.uint16)
    current = generator.permutation(r)[:h]
    for image in range(n):
        for place in np.flatnonzero(generator.random(h) > keep):
            others = [landmark for landmark in generator.integers(0, r, h + 1) if landmark not in current]
            current[place] = others[0] if others else current[place]
        lists[:, image] = current
    return lists


@pytest.mark.parametrize(("kind", "limit_bits"), [("uniform", 60), ("skewed", 60), ("runs", 40)])
def test_the_index_of_a_campus_fits_the_papers_size(
    make_map: MakeMap, kind: str, limit_bits: float, tmp_path: Path
) -> None:
    """26,208 images, r = 500, h = 4: at most 15h = 60 bits a map image, the pages of the posting table (II-C)."""
    n, r, h = 26_208, 500, 4
    generator = np.random.default_rng(0)
    if kind == "uniform":
        lists = np.argsort(generator.random((n, r), dtype=np.float32), axis=1)[:, :h].T.astype(np.uint16)
    elif kind == "skewed":
        popularity = -np.log(np.arange(1, r + 1)) + generator.gumbel(size=(n, r))
        lists = np.argsort(-popularity, axis=1)[:, :h].T.astype(np.uint16)
    else:
        lists = _with_runs(generator, n, r, h, keep=0.7)
    path = tmp_path / "map.sqlite"
    write_map(
        tmp_path / "map",
        make_map(n=n, r=r, lists=np.ascontiguousarray(lists), landmark_model={"p": np.full((r, 4096), 0.1, "f4")}),
    )
    seal(tmp_path / "map", path)
    bits = index_bytes(path) * 8 / n
    print(f"{kind}: {bits:.1f} bits a map image")
    assert bits <= limit_bits
    tables = table_bytes(path)
    assert tables["landmark_model"] >= r * 4096 * 4
    assert sum(tables.values()) == path.stat().st_size
    seconds = []
    for _ in range(3):
        started = time.perf_counter()
        back = read_map(path)
        seconds.append(time.perf_counter() - started)
    assert np.array_equal(back.lists, lists)
    assert min(seconds) < 0.15


@pytest.mark.parametrize("blob_bytes", [10, 90, 700, 2_000, 5_000, 20_000])
def test_the_chosen_page_size_is_close_to_the_best(blob_bytes: int, tmp_path: Path) -> None:
    def real_cost(page_size: int) -> int:
        path = tmp_path / f"{page_size}.sqlite"
        connection = sqlite3.connect(path)
        connection.execute(f"PRAGMA page_size = {page_size}")
        connection.execute("CREATE TABLE posting (a, b, c BLOB, PRIMARY KEY (a, b)) WITHOUT ROWID")
        connection.executemany(
            "INSERT INTO posting VALUES (?, ?, ?)", [(n // 4, n % 4, b) for n, b in enumerate(blobs)]
        )
        connection.commit()
        connection.execute("VACUUM")
        connection.close()
        return path.stat().st_size - page_size

    blobs = [bytes(blob_bytes + n % 50) for n in range(400)]
    costs = {size: real_cost(size) for size in (4096, 8192, 16384, 32768, 65536)}
    assert costs[_fitting_page_size([len(blob) for blob in blobs])] <= 1.2 * min(costs.values())
