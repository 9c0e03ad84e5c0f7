"""One map version as a self-contained file: landmark model, inverted index, route, experience."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.core.packing import pack_index, unpack_index
from deepsimbad.errors import DamagedMapError, InvalidMapConfigError
from deepsimbad.store.arrays import Checksum, load_arrays, save_arrays
from deepsimbad.store.connection import in_todays_schema, open_database
from deepsimbad.store.durable import remove_database
from deepsimbad.store.experience import EXPERIENCE_TABLE, load_experience, save_experience
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.pages import bytes_by_table, fitting_page_size
from deepsimbad.store.records import from_json, to_json
from deepsimbad_migrations.map.migrations import migrations

_DESCRIPTION = (  # the columns of `map` in the order of the checksum
    "domain",
    "version",
    "created_at",
    "config",
    "evaluator",
    "closed",
    "actions_m",
    "metrics",
    "n_map_images",
    "n_landmarks",
    "list_length",
)
_NO_PLAIN_TABLE = "SELECT 1 FROM sqlite_schema WHERE type NOT IN ('table', 'index') OR rootpage = 0 LIMIT 1"
_WAL_HEADER = bytes([2, 2])  # read and write version at offset 18 of a file that may have a write-ahead log


# Which array table holds which attributes; None: the landmark model's own names.
_TABLES: dict[str, tuple[str, ...]] = {
    "calibration": ("correlation", "listed_score", "telling_bits", "off_route_model"),
    "landmark_statistics": ("statistics", "loadings"),
    "listed_dissimilarity": ("values",),
    "map_image_encoding": ("encodings",),
    EXPERIENCE_TABLE: ("q_values",),
    "route": ("position_m", "timestamp_us", "x_m", "y_m", "frame_digest"),
}
_MODEL_TABLE = "landmark_model"


def write_map(path: Path, contents: MapContents, on_progress: Callable[[float], None] | None = None) -> None:
    """Write a new, unsealed map file; one of the same name is replaced.

    It is not synced: only `sealing.seal` makes it durable. A failure leaves no file.

    Args:
        path: Where; `Catalog.building_path`.
        contents: What.
        on_progress: Called with 0..1; what it raises (a cancel) ends the writing.

    Raises:
        InvalidMapConfigError: The parts do not fit together.
        UnavailableError: The disk is full, read-only, ...
    """
    contents.check()
    report = on_progress or (lambda _: None)
    postings = list(pack_index(contents.lists, contents.n_landmarks))
    report(0.3)
    with storage_faults(path, DamagedMapError):
        remove_database(path)
        try:
            with open_database(path, create=True) as db:
                db.execute(f"PRAGMA page_size = {fitting_page_size([len(blob) for _, _, blob in postings])}")
                db.execute("PRAGMA journal_mode = MEMORY")  # a crash leaves a file that is discarded anyway
                db.execute("PRAGMA synchronous = OFF")
                migrations.apply(db)
                with db.atomic():
                    _write(db, contents, postings, report)
        except BaseException:
            remove_database(path)
            raise
    report(1.0)


def _write(
    db: Database,
    contents: MapContents,
    postings: list[tuple[int, int, bytes]],
    report: Callable[[float], None],
) -> None:
    checksum = Checksum()
    description: dict[str, str | int] = {
        "domain": contents.domain,
        "version": contents.version,
        "created_at": contents.created_at,
        "config": to_json(contents.config),
        "evaluator": to_json(contents.evaluator),
        "closed": int(contents.closed),
        "actions_m": to_json(list(contents.actions_m)),
        "metrics": to_json(contents.metrics),
        "n_map_images": contents.n_map_images,
        "n_landmarks": contents.n_landmarks,
        "list_length": contents.list_length,
    }
    checksum.add(*(description[column] for column in _DESCRIPTION))
    for posting in postings:
        checksum.add(*posting)
    db.conn.executemany("INSERT INTO posting (landmark, rank, image_ids) VALUES (?, ?, ?)", postings)
    report(0.5)
    save_arrays(db, _MODEL_TABLE, contents.landmark_model, checksum)
    for table, names in _TABLES.items():
        present = {name: getattr(contents, name) for name in names if getattr(contents, name) is not None}
        if table == EXPERIENCE_TABLE:
            save_experience(db, contents.q_values, checksum)
        else:
            save_arrays(db, table, present, checksum)
        report(0.7)
    db.table("map").insert({"id": 1, **description, "checksum": checksum.value})


def read_map(path: Path) -> MapContents:
    """Read a map file whole and check it against its own checksum.

    A file of an older schema is brought to today's in memory; the sealed file stays as it is.

    Raises:
        DamagedMapError: The file is missing, damaged, of another kind or from a newer release; the cause is chained.
        UnavailableError: The disk failed, no memory is left, ...: the file may be whole.
    """
    try:
        with _opened(path) as db:
            return _read(db, path)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, RecursionError) as error:
        raise DamagedMapError(f"{path.name} is damaged: {error}", file=path.name) from error
    except InvalidMapConfigError as error:
        raise DamagedMapError(f"{path.name} is damaged: {error.message}", file=path.name) from error


def _read(db: Database, path: Path) -> MapContents:
    rows = list(db.table("map").rows)
    if not rows:
        raise DamagedMapError(f"{path.name} is damaged: it was never finished", file=path.name)
    stored = rows[0]
    checksum = Checksum()
    checksum.add(*(stored[column] for column in _DESCRIPTION))
    postings = db.execute("SELECT landmark, rank, image_ids FROM posting ORDER BY landmark, rank").fetchall()
    for posting in postings:
        checksum.add(*posting)
    model = load_arrays(db, _MODEL_TABLE, checksum)
    arrays: dict[str, NDArray[Any]] = {}
    for table in _TABLES:
        load = load_experience if table == EXPERIENCE_TABLE else load_arrays
        arrays |= load(db, table, checksum)
    if checksum.value != stored["checksum"]:
        raise DamagedMapError(f"{path.name} is damaged: it does not match its checksum", file=path.name)
    lists = unpack_index(postings, stored["list_length"], stored["n_map_images"])
    lists.setflags(write=False)
    contents = MapContents(
        domain=stored["domain"],
        version=stored["version"],
        created_at=stored["created_at"],
        config=from_json(stored["config"]),
        evaluator=from_json(stored["evaluator"]),
        closed=bool(stored["closed"]),
        actions_m=tuple(from_json(stored["actions_m"])),
        landmark_model=model,
        lists=lists,
        metrics=from_json(stored["metrics"]),
        **arrays,
    )
    contents.check()
    return contents


def index_bytes(path: Path) -> int:
    """The pages of the posting table, in bytes (the paper's size figure); raises as `read_map`."""
    return table_bytes(path)["posting"]


def table_bytes(path: Path) -> dict[str, int]:
    """The pages of every table with its indexes, in bytes; raises as `read_map`."""
    with _opened(path) as db:
        return bytes_by_table(db.conn)


@contextmanager
def _opened(path: Path) -> Iterator[Database]:
    """A map file open for reading, of today's schema."""
    if not path.is_file():
        raise DamagedMapError(f"{path.name} is missing", file=path.name)
    with storage_faults(path, DamagedMapError):
        with path.open("rb") as stream:
            if stream.read(20)[18:] == _WAL_HEADER:  # its newest rows may lie beside it
                raise DamagedMapError(f"{path.name} was opened for writing after it was sealed", file=path.name)
        with open_database(path, immutable=True) as db:
            if db.execute(_NO_PLAIN_TABLE).fetchone() is not None:  # reading it would run what its maker wrote
                raise DamagedMapError(f"{path.name} is damaged: it holds what no release writes", file=path.name)
            if not db.table_names():
                raise DamagedMapError(f"{path.name} is damaged: it is empty", file=path.name)
            with in_todays_schema(db, migrations, path, DamagedMapError) as current:
                yield current


__all__ = ["MapContents", "index_bytes", "read_map", "table_bytes", "write_map"]
