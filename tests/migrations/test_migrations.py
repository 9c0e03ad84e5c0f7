"""Every set of migrations: from empty, through sqlite-utils' own command, and from each frozen past schema."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib import import_module
from pathlib import Path

import pytest
from click.testing import CliRunner
from sqlite_utils import Database, Migrations
from sqlite_utils.cli import cli

import deepsimbad_migrations
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import JobState
from deepsimbad.store.sessions import PriorRow, SessionStore
from deepsimbad.store.traverses import Traverse

SETS = {
    name: import_module(f"deepsimbad_migrations.{name}.migrations").migrations
    for name in ("catalog", "map", "traverse", "session", "thumbnail")
}
SCHEMAS = Path(__file__).parent / "schemas"
FROZEN = sorted(SCHEMAS.glob("*.sql"))
MIGRATIONS = Path(deepsimbad_migrations.__file__).parent

Schema = dict[str, str]


def schema_of(path: Path) -> Schema:
    with closing(sqlite3.connect(path)) as connection:
        rows = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL")
        return {name: " ".join(sql.split()) for name, sql in rows}


def rows_of(path: Path) -> dict[str, list[dict[str, object]]]:
    with closing(sqlite3.connect(path)) as connection:
        connection.row_factory = sqlite3.Row
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        return {name: [dict(row) for row in connection.execute(f'SELECT * FROM "{name}"')] for name in names}


def apply(path: Path, migrations: Migrations, **options: str) -> None:
    with Database(sqlite3.connect(path, isolation_level=None)) as db:
        migrations.apply(db, **options)


def run_command(path: Path, folder: Path, *options: str) -> str:
    """Run sqlite-utils' migrate command and return its output."""
    result = CliRunner().invoke(cli, ["migrate", str(path), str(folder), *options])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(params=SETS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_the_command_reaches_the_schema_that_the_service_makes(kind: str, tmp_path: Path) -> None:
    applied, migrated = tmp_path / "ours.sqlite", tmp_path / "theirs.sqlite"
    apply(applied, SETS[kind])
    run_command(migrated, MIGRATIONS / kind)
    assert schema_of(migrated) == schema_of(applied)
    rows = rows_of(migrated)
    run_command(migrated, MIGRATIONS / kind)  # again changes nothing
    assert rows_of(migrated) == rows
    listing = run_command(migrated, MIGRATIONS / kind, "--list")
    assert SETS[kind].name in listing
    assert "m001" in listing.split("Pending")[0]


def test_every_step_has_a_frozen_dump(kind: str) -> None:
    with Database(memory=True) as db:
        n_steps = len(SETS[kind].pending(db))
    dumps = [path.name for path in FROZEN if path.name.startswith(f"{kind}_v")]
    assert dumps == [f"{kind}_v{step}.sql" for step in range(1, n_steps + 1)], (
        "freeze the new schema: dump a small file of it into tests/migrations/schemas"
    )


@pytest.mark.parametrize("dump", FROZEN, ids=lambda path: path.stem)
def test_a_shipped_step_is_never_edited(dump: Path, tmp_path: Path) -> None:
    """The present steps up to that of the dump make exactly the dump's schema."""
    kind, version = dump.stem.rsplit("_v", 1)
    with Database(memory=True) as db:
        steps = [step.name for step in SETS[kind].pending(db)]
    later = steps[int(version) :]
    apply(tmp_path / "now.sqlite", SETS[kind], **({"stop_before": later[0]} if later else {}))
    restore(dump, tmp_path / "then.sqlite")
    assert schema_of(tmp_path / "now.sqlite") == schema_of(tmp_path / "then.sqlite")


def restore(dump: Path, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(dump.read_text())


@pytest.mark.parametrize("dump", FROZEN, ids=lambda path: path.stem)
def test_a_past_file_reaches_today_and_keeps_its_rows(dump: Path, tmp_path: Path) -> None:
    kind = dump.stem.rsplit("_v", 1)[0]
    past, new = tmp_path / "past.sqlite", tmp_path / "new.sqlite"
    restore(dump, past)
    old_rows = rows_of(past)
    if dump.stem.endswith("_v1"):  # by hand, where most steps are missing
        run_command(past, MIGRATIONS / kind)
    else:
        apply(past, SETS[kind])
    apply(new, SETS[kind])
    assert schema_of(past) == schema_of(new)
    new_rows = rows_of(past)
    for table, rows in old_rows.items():
        if table in {"_sqlite_migrations", "clock"}:
            continue
        assert len(rows) >= 1 or table in ("doomed_folder", "map_image_encoding"), f"the dump shows no {table}"
        assert len(new_rows[table]) == len(rows)
        for old_row, row in zip(rows, new_rows[table], strict=True):
            lost = dict(old_row.items() - row.items())
            assert lost.keys() <= {"checksum", "owner", "image_ids"}


def the_catalog(data_dir: Path) -> Iterator[object]:
    with Catalog.open(data_dir) as catalog:
        (record,) = catalog.maps("campus")
        yield (catalog.domain("campus").active_version, record.metrics, record.activated_at)
        yield [(job.state, job.n_starts) for job in catalog.jobs("campus")]
    assert not (data_dir / "domains").exists()


def the_traverse(data_dir: Path) -> Iterator[object]:
    with Traverse.open(data_dir, "campus", "summer") as traverse:
        frames = traverse.read()
        yield frames.encodings.tolist()
        yield (traverse.summary().missing, frames.timestamp_us.tolist())


def the_map(data_dir: Path) -> Iterator[object]:
    contents = read_map(data_dir / "domains/campus/maps/000001.sqlite")
    yield contents.lists.tolist()
    yield contents.landmark_model["prototypes"].tolist()
    yield (contents.closed, tuple(contents.actions_m.tolist()), contents.position_m.tolist(), contents.metrics)
    yield contents.q_values.round(2).tolist()


def the_sessions(data_dir: Path) -> Iterator[object]:
    with SessionStore.open(data_dir) as store:
        (alive,) = store.living_sessions()
        yield (alive.session_id, alive.config, alive.n_events, alive.expires_at)
        snapshot, rows = store.history(alive.number, last_sequence=3)
        assert snapshot is not None
        yield (snapshot.sequence, snapshot.arrays["mass"].tolist(), [row.sequence for row in rows])
        _, (first, second) = store.history(alive.number, last_sequence=2)
        yield (first, second) == (first, PriorRow(2, 4620.0, 1.5, 2.0))
        yield store.find_observation(alive.number, "k1")


MAP_FILE = "domains/campus/maps/000001.sqlite"
MAP: list[object] = [
    [[0, 1, 2, 0], [1, 2, 0, 2]],
    [[0, 1], [2, 3], [4, 5]],
    (True, (1.0, 2.0, 3.0), [0.0, 1.5, 3.0, 4.5], {"anr": 4.5}),
]
Q_VALUES = [[0.0, 25.0, 50.0], [75.0, 100.0, 125.0], [150.0, 175.0, 200.0], [225.0, 250.0, 275.0]]
FRAMES = [[[1, 2], [3, 4], [5, 6]], ([(2, 2)], [10, -1, 30])]
SESSION = [("a" * 32, {"filter": "grid", "seed": 7}, 3, 4630.0), (2, [0.25, 0.75], [3]), True, (1, b"\x01\x02")]


@pytest.mark.parametrize(
    ("dump", "place", "read", "expected"),
    [
        ("catalog_v1", "catalog.sqlite", the_catalog, [(1, {"anr": 4.5}, None), [(JobState.SUCCEEDED, 0)]]),
        *(
            (
                *(f"catalog_v{version}", "catalog.sqlite", the_catalog),
                [(1, {"anr": 4.5}, "2026-11-20T10:00:00.000Z"), [(JobState.SUCCEEDED, 2)]],
            )
            for version in (2, 3, 4, 5, 6, 7)
        ),
        *((f"traverse_v{v}", "domains/campus/traverses/summer.sqlite", the_traverse, FRAMES) for v in range(1, 9)),
        *((f"session_v{version}", "sessions.sqlite", the_sessions, SESSION) for version in (1, 2, 3, 4, 5)),
        *((f"map_v{v}", MAP_FILE, the_map, [*MAP, Q_VALUES]) for v in (4, 5)),  # no release wrote earlier ones
    ],
)
def test_todays_code_reads_past_files(
    dump: str, place: str, read: Callable[[Path], Iterator[object]], expected: list[object], tmp_path: Path
) -> None:
    restore(SCHEMAS / f"{dump}.sql", tmp_path / place)
    assert list(read(tmp_path)) == expected
