"""A map file: written, sealed and read back exactly, or damaged by name."""

import hashlib
import sqlite3
import stat
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.core.map import Map
from deepsimbad.errors import CancelledError, ConflictError, DamagedMapError, InvalidInputError, UnavailableError
from deepsimbad.store import arrays
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import adopt, index_bytes, read_map, seal, table_bytes, verify, write_map

from .conftest import MakeMap


def is_equal(left: Map, right: Map) -> bool:
    """Whether two maps are equal, their Q-values within half of one of 65,535 steps from the lowest to the highest."""
    left_arrays, right_arrays = ({**map_.arrays(), **map_.landmark_model} for map_ in (left, right))
    if left.document() != right.document() or left_arrays.keys() != right_arrays.keys():
        return False
    for name, array in left_arrays.items():
        steps = (float(array.max()) - float(array.min())) / 65_535 if name == "q_values" else 0.0
        is_text = array.dtype.kind == "U"
        is_alike = (
            np.array_equal(array, right_arrays[name], equal_nan=not is_text)
            or np.abs(array - right_arrays[name]).max() <= steps
        )
        if array.dtype != right_arrays[name].dtype or not is_alike:
            return False
    return True


@pytest.fixture
def path(make_map: MakeMap, tmp_path: Path) -> Path:
    """A map that was written and not yet sealed."""
    write_map(tmp_path / "map", make_map())
    return tmp_path / "map"


@pytest.fixture
def final(path: Path) -> Path:
    """Where the map lies once it is sealed."""
    return path.with_name("000001.sqlite")


def everything(make_map: MakeMap) -> Map:
    generator = np.random.default_rng(1)
    return make_map(
        closed=True,
        values=generator.random((4, 60), dtype=np.float32),
        encodings=generator.random((60, 8), dtype=np.float32),
        frame_digest=generator.integers(2**64, size=60, dtype=np.uint64),
        frame_name=np.array([f"{i}" * (i % 7) for i in range(60)]),
        frame_drive=np.full(60, "summer"),
        landmark_digest=generator.integers(2**64, size=20, dtype=np.uint64),
        landmark_frame=np.array([f"{i}" * (i % 7) for i in range(20)]),
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
        assert is_equal(replace(contents, landmark_model=little_endian), back)
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
    with closing(sqlite3.connect(tmp_path / "map")) as connection:
        (n_parts,) = connection.execute("SELECT count(*) FROM map_image_encoding").fetchone()
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


def test_a_failed_or_cancelled_write_leaves_nothing(make_map: MakeMap, tmp_path: Path) -> None:
    path = tmp_path / "map"
    with pytest.raises(InvalidInputError, match="numbers"):
        write_map(path, make_map(landmark_model={"words": np.array(["a"])}))
    shares: list[float] = []

    def cancel(progress: float) -> None:
        shares.append(progress)
        if progress > 0.5:
            raise CancelledError("asked to stop")

    with pytest.raises(CancelledError):
        write_map(path, make_map(), cancel)
    assert shares == sorted(shares)
    with pytest.raises(UnavailableError):
        write_map(tmp_path / "no folder" / "map", make_map())
    assert list(tmp_path.iterdir()) == []
    write_map(path, make_map(), shares.append)
    assert shares[-1] == 1.0


def test_no_flipped_byte_breaks_the_reader(make_map: MakeMap, tmp_path: Path) -> None:
    """What a changed value says is the digest's to notice; the reader answers with a map or a named error."""
    path = tmp_path / "map"
    write_map(path, everything(make_map))
    content = path.read_bytes()
    generator = np.random.default_rng(0)
    n_seen = 0
    for at in [*range(0, 100, 2), *generator.integers(0, len(content), 400).tolist()]:
        path.write_bytes(content[:at] + bytes([content[at] ^ (1 << int(generator.integers(8)))]) + content[at + 1 :])
        try:
            read_map(path)
            table_bytes(path)
        except (DamagedMapError, UnavailableError):
            n_seen += 1
    assert n_seen > 20


def test_files_that_are_no_maps_are_damaged_maps(path: Path, tmp_path: Path) -> None:
    with pytest.raises(DamagedMapError, match="missing"):
        read_map(tmp_path / "nowhere")
    map_bytes = path.read_bytes()
    with Catalog.open(tmp_path / "data"):
        pass
    foreign = (tmp_path / "data/catalog.sqlite").read_bytes()
    unmarked = tmp_path / "foreign"
    with closing(sqlite3.connect(unmarked)) as connection:
        connection.execute("CREATE TABLE map (id)")
    contents = [b"", b"x", b"GIF89a" * 1000, map_bytes[:99], foreign, unmarked.read_bytes()]
    contents += [map_bytes[:length] for length in range(4096, len(map_bytes), 4096)]
    for content in contents:
        path.write_bytes(content)
        for read in (read_map, index_bytes):
            if read is index_bytes and content[:99] == map_bytes[:99]:
                continue  # page counts of a file that lost its end may still stand
            with pytest.raises(DamagedMapError):
                read(path)


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO _sqlite_migrations (migration_set, name) VALUES ('deepsimbad_map', 'm999_future')",
        "DELETE FROM map",
        "DELETE FROM posting",
        "UPDATE posting SET body = zeroblob(length(body))",
        "UPDATE map SET n_map_images = 1000000000000",
        "UPDATE map SET config = '{'",
        "UPDATE map SET config = '{}'",
        "UPDATE route SET shape = '[1000000000000000]'",
        "UPDATE route SET dtype = 'O'",
        "UPDATE route SET dtype = 'no such'",
        "DELETE FROM route WHERE name = 'position_m'",
        "UPDATE q_value SET step = NULL",
        "UPDATE q_value SET body = zeroblob(40)",
        "UPDATE q_value SET shape = '[6000000000, 3]'",
        "INSERT INTO q_value SELECT 1, name, dtype, shape, lowest, step, body FROM q_value",
    ],
)
def test_altered_maps_are_damaged_maps(path: Path, statement: str) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute(statement)
    with pytest.raises(DamagedMapError):
        read_map(path)


def test_the_index_of_a_campus_fits_the_papers_size(make_map: MakeMap, tmp_path: Path) -> None:
    """26,208 images, r = 500, h = 4: far below 15h = 60 bits a map image, the pages of the posting table (II-C)."""
    n, r, h = 26_208, 500, 4
    generator = np.random.default_rng(0)
    lists = np.argsort(generator.random((n, r), dtype=np.float32), axis=1)[:, :h].T.astype(np.uint16)
    path = tmp_path / "map.sqlite"
    write_map(
        tmp_path / "map",
        make_map(n=n, r=r, lists=np.ascontiguousarray(lists), landmark_model={"p": np.full((r, 4096), 0.1, "f4")}),
    )
    seal(tmp_path / "map", path)
    assert index_bytes(path) * 8 / n <= 38
    tables = table_bytes(path)
    assert tables["landmark_model"] >= r * 4096 * 4
    assert sum(tables.values()) == path.stat().st_size
    assert np.array_equal(read_map(path).lists, lists)


def test_a_sealed_map_is_whole_alone_and_read_only(path: Path, final: Path) -> None:
    digest, n_bytes = seal(path, final)
    assert digest == hashlib.sha256(final.read_bytes()).hexdigest()
    assert n_bytes == final.stat().st_size
    assert stat.S_IMODE(final.stat().st_mode) == 0o444
    verify(final, digest)
    assert read_map(final).domain == "campus"
    assert list(path.parent.iterdir()) == [final], "sealing and reading leave nothing beside it"
    assert digest == hashlib.sha256(final.read_bytes()).hexdigest()


def test_a_sealed_map_is_never_replaced(make_map: MakeMap, path: Path, final: Path) -> None:
    digest, _ = seal(path, final)
    write_map(path, make_map(seed=1))
    with pytest.raises(ConflictError):
        seal(path, final)
    verify(final, digest)
    assert path.exists()


def test_a_changed_file_fails_its_digest(path: Path, final: Path) -> None:
    digest, n_bytes = seal(path, final)
    content = final.read_bytes()
    for at in range(0, n_bytes, 997):
        final.chmod(0o644)
        final.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        with pytest.raises(DamagedMapError):
            verify(final, digest)
    with pytest.raises(DamagedMapError, match="SHA-256 differs"):
        adopt(final, final.with_name("b.sqlite"), digest)
    assert list(final.parent.iterdir()) == [final]
    final.write_bytes(content[:-1])
    with pytest.raises(DamagedMapError):
        verify(final, digest)
    final.unlink()
    with pytest.raises(DamagedMapError, match="missing"):
        verify(final, digest)


def test_what_cannot_be_read_back_is_not_sealed(make_map: MakeMap, path: Path, final: Path) -> None:
    with pytest.raises(UnavailableError):
        seal(path.with_name("nowhere"), final)
    map_bytes = path.read_bytes()
    for content in (b"nothing of the kind" * 500, map_bytes[: len(map_bytes) // 2]):
        path.write_bytes(content)
        with pytest.raises(DamagedMapError):
            seal(path, final)
        assert not final.exists()
        assert not final.with_suffix(".sealing").exists()


def test_a_disk_that_takes_no_more_is_named_and_leaves_nothing(path: Path, final: Path) -> None:
    """The kernel's limit on file sizes stands for the full disk, in a process of its own."""
    script = """
import resource, sys
from pathlib import Path
from deepsimbad.errors import UnavailableError
from deepsimbad.store.map_file import seal
resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, 8_000))
try:
    seal(*map(Path, sys.argv[1:]))
except UnavailableError as error:
    print(error.hints["reason"])
"""
    process = subprocess.run([sys.executable, "-c", script, path, final], check=True, capture_output=True, text=True)
    assert process.stdout.strip() in ("disk_full", "io_error")
    assert list(path.parent.iterdir()) == [path]
    seal(path, final)
