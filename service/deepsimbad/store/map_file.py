"""One map version as a self-contained file: its description, index, and named arrays; sealing and export.

What the arrays mean is not known here: `core.map` names them, a table holds each.
"""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from sqlite_utils import Database

from deepsimbad.core.index.packing import pack_lists, unpack_lists
from deepsimbad.core.map import Map
from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    InvalidMapConfigError,
    InvalidRouteError,
    NoActiveMapError,
)
from deepsimbad.store.arrays import load_arrays, load_packed, pack_texts, save_arrays, save_packed, unpack_texts
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.connection import check_integrity, in_todays_schema, open_database
from deepsimbad.store.durable import remove_database, sha256_of, storage_faults, sync, verify, written_aside
from deepsimbad.store.records import MapRecord, from_json, to_json
from deepsimbad_migrations.map.migrations import migrations

_AS_JSON = frozenset({"config", "evaluator", "actions_m", "metrics"})  # columns of `map`
_PAGE_SIZES = (65536, 32768, 16384, 8192, 4096, 2048, 1024, 512)
_ROW_OVERHEAD = 12  # cell pointer, cell and record headers, the number of a block
_WORTH_SMALLER_PAGES = 1.01  # of the index's bytes: with small pages all else takes more of them

_MODEL_TABLE, _PACKED_TABLE = "landmark_model", "q_value"
# In which table of the frozen schema an array lies, all of one layout; what is not named here, what seasons teach.
_TABLE_OF = {
    **dict.fromkeys(
        ("statistics", "loadings", "landmark_digest", "landmark_frame", "landmark_drive"), "landmark_statistics"
    ),
    "values": "listed_dissimilarity",
    "encodings": "map_image_encoding",
    "q_values": _PACKED_TABLE,
    **dict.fromkeys(("position_m", "timestamp_us", "x_m", "y_m", "frame_digest", "frame_name", "frame_drive"), "route"),
}
_TEXTS = {  # and the column of `map` that tells how many
    **dict.fromkeys(("frame_name", "frame_drive"), "n_map_images"),
    **dict.fromkeys(("landmark_frame", "landmark_drive"), "n_landmarks"),
}
_TABLES = ("calibration", "landmark_statistics", "listed_dissimilarity", "map_image_encoding", _PACKED_TABLE, "route")


def write_map(path: Path, map_: Map, on_progress: Callable[[float], None] = lambda _: None) -> None:
    """Write a new, unsealed map file; one of the same name is replaced, and a failure leaves none.

    It is not synced: only `seal` makes it durable. `on_progress` is told 0..1; what it raises (a cancel) ends it.

    Raises:
        InvalidInputError: A Q-value is NaN or infinite.
        UnavailableError: The disk is full, read-only, ...
    """
    blocks = pack_lists(map_.lists, map_.n_landmarks, map_.landmark_model.get("prototypes"))
    on_progress(0.3)
    with storage_faults(path, DamagedMapError):
        remove_database(path)
        try:
            with open_database(path, create=True) as db:
                db.execute(f"PRAGMA page_size = {_fitting_page_size([len(block) for block in blocks])}")
                db.execute("PRAGMA journal_mode = MEMORY")  # a crash leaves a file that is discarded anyway
                db.execute("PRAGMA synchronous = OFF")
                migrations.apply(db)
                with db.atomic():
                    # A file's bytes follow from its map alone, which says when it was made.
                    db.execute("UPDATE _sqlite_migrations SET applied_at = ?", [map_.created_at])
                    _write(db, map_, blocks, on_progress)
        except BaseException:
            remove_database(path)
            raise
    on_progress(1.0)


def _write(db: Database, map_: Map, blocks: list[bytes], on_progress: Callable[[float], None]) -> None:
    description = {
        column: to_json(value) if column in _AS_JSON else int(value) if isinstance(value, bool) else value
        for column, value in map_.document().items()
    }
    db.conn.executemany("INSERT INTO posting (body) VALUES (?)", [(block,) for block in blocks])
    on_progress(0.5)
    save_arrays(db, _MODEL_TABLE, map_.landmark_model)
    arrays = {
        name: pack_texts(array) if name in _TEXTS else array for name, array in map_.arrays().items() if name != "lists"
    }
    for table in _TABLES:
        table_arrays = {name: array for name, array in arrays.items() if _TABLE_OF.get(name, "calibration") == table}
        (save_packed if table == _PACKED_TABLE else save_arrays)(db, table, table_arrays)
        on_progress(0.7)
    db.table("map").insert({"id": 1, **description})


def read_map(path: Path) -> Map:
    """Read a map file whole.

    A file of an older schema is brought to today's in memory; the sealed file stays as it is.

    Raises:
        DamagedMapError: The file is missing, damaged, of another kind or from a newer release; the cause is chained.
        UnavailableError: The disk failed, no memory is left, ...: the file may be whole.
    """
    try:
        with _open_map(path) as db:
            return _read(db, path)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, RecursionError) as error:
        raise DamagedMapError(f"{path.name} is damaged: {error}", file=path.name) from error
    except (InvalidMapConfigError, InvalidRouteError) as error:
        raise DamagedMapError(f"{path.name} is damaged: {error.message}", file=path.name) from error


def _read(db: Database, path: Path) -> Map:
    rows = list(db.table("map").rows)
    if not rows:
        raise DamagedMapError(f"{path.name} is damaged: it was never finished", file=path.name)
    row = rows[0]
    blocks = [body for (body,) in db.execute("SELECT body FROM posting ORDER BY part")]
    model = load_arrays(db, _MODEL_TABLE)
    arrays: dict[str, NDArray[Any]] = {}
    for table in _TABLES:
        arrays |= (load_packed if table == _PACKED_TABLE else load_arrays)(db, table)
    arrays |= {name: unpack_texts(arrays[name], row[_TEXTS[name]]) for name in _TEXTS.keys() & arrays.keys()}
    shape = row["list_length"], row["n_map_images"], row["n_landmarks"]
    arrays["lists"] = unpack_lists(blocks, *shape, model.get("prototypes"))
    document = {name: from_json(value) if name in _AS_JSON else value for name, value in row.items() if name != "id"}
    return Map.from_arrays(document, model, arrays, _bytes_by_table(db)["posting"])


def index_bytes(path: Path) -> int:
    """The pages of the posting table, in bytes (the paper's size figure); raises as `read_map`."""
    return table_bytes(path)["posting"]


def table_bytes(path: Path) -> dict[str, int]:
    """The pages of every table with its indexes, in bytes; raises as `read_map`."""
    with _open_map(path) as db:
        return _bytes_by_table(db)


def _bytes_by_table(db: Database) -> dict[str, int]:
    rows = db.execute(
        """
        SELECT coalesce(tbl_name, dbstat.name), sum(pgsize)
        FROM dbstat LEFT JOIN sqlite_schema USING (name) GROUP BY 1
        """
    )
    return dict(rows.fetchall())


@contextmanager
def _open_map(path: Path) -> Iterator[Database]:
    """A map file open for reading, of today's schema."""
    if not path.is_file():
        raise DamagedMapError(f"{path.name} is missing", file=path.name)
    try:
        with storage_faults(path, DamagedMapError), open_database(path, immutable=True) as db:
            if not db.table_names():
                raise DamagedMapError(f"{path.name} is damaged: it is empty", file=path.name)
            with in_todays_schema(db, migrations, path) as current_db:
                yield current_db
    except DamagedFileError as error:
        raise DamagedMapError(error.message, **error.hints) from error


def _fitting_page_size(block_lengths: Sequence[int]) -> int:
    """The largest page size that stores blocks of these lengths in nearly the fewest bytes.

    Pages are counted whole, and the last of a block's stays part empty: of a small map's index that is a good part.
    """

    def cost(page_size: int) -> int:
        n_pages, room = 1, page_size - 8
        for length in block_lengths:
            local, n_spilled = _spill(length + _ROW_OVERHEAD, page_size)
            n_pages += n_spilled
            if local > room:
                n_pages, room = n_pages + 1, page_size - 8
            room -= local
        return n_pages * page_size

    min_bytes = min(map(cost, _PAGE_SIZES))
    return next(size for size in _PAGE_SIZES if cost(size) <= _WORTH_SMALLER_PAGES * min_bytes)


def _spill(payload: int, page_size: int) -> tuple[int, int]:
    """The bytes of a row that stay in its page, and its overflow pages (SQLite file format, 1.6)."""
    max_local, min_local = page_size - 35, (page_size - 12) * 32 // 255 - 23
    if payload <= max_local:
        return payload, 0
    local = min_local + (payload - min_local) % (page_size - 4)
    if local > max_local:
        local = min_local
    return local, -(-(payload - local) // (page_size - 4))


def seal(building_path: Path, final_path: Path) -> tuple[str, int]:
    """Seal a built map: check it, compact it, sync it, name it, make it read-only; the building file is gone then.

    The final name appears in one rename, after everything under it is on the disk; a crash before leaves no such file.

    Returns:
        (SHA-256 in hex, bytes) of the sealed file.

    Raises:
        DamagedMapError: What was built cannot be read back.
        ConflictError: A file of the final name is there.
        UnavailableError: The disk is full, read-only, ...
    """
    with _taking_its_name(final_path) as sealing_path:
        with open_database(building_path) as db:
            check_integrity(db, building_path)
            db.conn.execute("VACUUM INTO CAST(? AS TEXT)", [os.fsencode(sealing_path)])  # UTF-8 or not
        read_map(sealing_path)
        digest, n_bytes = sha256_of(sealing_path), sealing_path.stat().st_size
    with storage_faults(building_path):
        remove_database(building_path)
    return digest, n_bytes


def adopt(source: Path, final_path: Path, sha256: str) -> int:
    """Let the copy of a file that was sealed elsewhere take a final name, as `seal` does; returns its bytes.

    Raises:
        DamagedMapError: The copy does not match its digest.
        ConflictError: A file of the final name is there.
        UnavailableError: The disk is full, read-only, ...
    """
    with _taking_its_name(final_path) as sealing_path:
        shutil.copyfile(source, sealing_path)
        verify(sealing_path, sha256)
    return final_path.stat().st_size


def fetch(pieces: Iterable[bytes], final_path: Path, sha256: str) -> None:
    """As `adopt`, of a file that comes in pieces from elsewhere, in the place of one that may be there."""
    with storage_faults(final_path):
        final_path.parent.mkdir(parents=True, exist_ok=True)
        remove_database(final_path)
    with _taking_its_name(final_path) as sealing_path:
        with sealing_path.open("xb") as stream:
            stream.writelines(pieces)
        verify(sealing_path, sha256)


@contextmanager
def _taking_its_name(final_path: Path) -> Iterator[Path]:
    """Where to write what, at the end of the block, is made read-only, synced and given its final name, or removed."""
    sealing_path = final_path.with_suffix(".sealing")
    with storage_faults(final_path, DamagedMapError):
        if final_path.exists():
            raise ConflictError(f"{final_path.name} is sealed already; a sealed map never changes")
        remove_database(sealing_path)
        try:
            yield sealing_path
            sealing_path.chmod(0o444)
            sync(sealing_path)
            sealing_path.rename(final_path)
        except BaseException as error:
            remove_database(sealing_path)
            if isinstance(error, DamagedFileError):
                raise DamagedMapError(error.message, **error.hints) from error
            raise
        sync(final_path.parent)


def export_map(catalog: Catalog, domain: str, version: int | None, file: Path) -> MapRecord:
    """Copy a sealed map, the active one where no version is named, byte for byte into a new file.

    Raises:
        UnknownDomainError, UnknownMapVersionError, NoActiveMapError: There is no such map.
        RetiredMapError: Its file was removed.
        DamagedMapError: Its file is not what was sealed; nothing is written.
        ConflictError: There is a file of that name.
        InvalidInputError: There is no folder for it.
        UnavailableError: The disk is full, ...
    """
    if version is None:
        version = catalog.domain(domain).active_version
        if version is None:
            raise NoActiveMapError(f"domain {domain} has no active map: name another with --version", domain=domain)
    sha256 = catalog.sealed_digest(domain, version)
    try:
        with storage_faults(file), written_aside(file, "an export") as new_path:
            shutil.copyfile(catalog.map_file(domain, version), new_path)
            verify(new_path, sha256)
            new_path.chmod(0o444)
    except DamagedMapError as error:
        raise DamagedMapError(
            f"map {version} of domain {domain} is damaged and was not exported: {error.message}",
            domain=domain,
            map_version=version,
        ) from error
    return catalog.map(domain, version)
