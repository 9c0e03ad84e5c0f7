"""In which order files are written, synced and named: a power cut between two of these lines must lose nothing."""

import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepsimbad.store import connection
from deepsimbad.store.backup import back_up, restore
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.map_file import export_map
from deepsimbad.store.sessions import ObservedRow, SessionRecord, SessionStore
from deepsimbad.store.traverses import Traverse

from .conftest import AddMap

_CALLS = ("fsync", "rename", "replace", "link", "chmod", "unlink", "mkdir")


class Tape:
    """What was asked of the system and of SQLite, one line each, with names relative to a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.lines: list[str] = []

    def name(self, path: Any) -> str:
        text = Path(f"/proc/self/fd/{path}").readlink() if isinstance(path, int) else os.fspath(path)
        return os.path.relpath(text, self._folder)

    def since(self, act: Callable[[], Any], *only: str) -> list[str]:
        """The lines that an act adds, of them those that begin so (none given: all)."""
        n_before = len(self.lines)
        act()
        return [line for line in self.lines[n_before:] if not only or line.split()[0] in only]


@pytest.fixture
def tape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tape:
    tape = Tape(tmp_path)

    def recorded(call: str) -> Callable[..., Any]:
        real = getattr(os, call)

        def record(*arguments: Any, **options: Any) -> Any:
            paths = arguments[: 2 if call in {"rename", "replace", "link"} else 1]
            answer = real(*arguments, **options)
            tape.lines.append(" ".join([call, *(tape.name(path) for path in paths)]))
            return answer

        return record

    for call in _CALLS:
        monkeypatch.setattr(os, call, recorded(call))
    connect = sqlite3.connect

    def traced(path: str, **options: Any) -> sqlite3.Connection:
        traced_connection = connect(path, **options)
        name = tape.name(path.removeprefix("file://").partition("?")[0])

        def record(statement: str) -> None:
            words = statement.split()
            if words[0] in {"COMMIT", "VACUUM"}:
                tape.lines.append(f"{words[0]} {name}")

        traced_connection.set_trace_callback(record)
        return traced_connection

    monkeypatch.setattr(connection.sqlite3, "connect", traced)
    return tape


def committed_for_good(db: sqlite3.Connection) -> bool:
    """Whether SQLite syncs its log before a COMMIT returns."""
    (mode,), (synchronous,) = (db.execute(f"PRAGMA {name}").fetchone() for name in ("journal_mode", "synchronous"))
    return (mode, synchronous) == ("wal", 2)


def test_sealing(tape: Tape, tmp_path: Path, add_map: AddMap) -> None:
    maps = "domains/campus/maps"
    with Catalog.open(tmp_path) as catalog:
        catalog.create_domain("campus", {}, False, [1, 2, 3])
        assert committed_for_good(catalog._db.conn)
        lines = tape.since(lambda: add_map(catalog), "VACUUM", "chmod", "fsync", "rename", "COMMIT")
        assert [line for line in lines if line != f"COMMIT {maps}/000001.building"] == [
            "COMMIT catalog.sqlite",
            f"VACUUM {maps}/000001.building",
            f"chmod {maps}/000001.sealing",
            f"fsync {maps}/000001.sealing",
            f"rename {maps}/000001.sealing {maps}/000001.sqlite",
            f"fsync {maps}",
            "COMMIT catalog.sqlite",
        ]


def test_activation_and_removal(tape: Tape, tmp_path: Path, add_map: AddMap) -> None:
    with Catalog.open(tmp_path) as catalog:
        catalog.create_domain("campus", {}, False, [1, 2, 3])
        for version in (1, 2):
            add_map(catalog)
            assert tape.since(lambda v=version: catalog.activate("campus", v, ANY)) == ["COMMIT catalog.sqlite"]
        maps = "domains/campus/maps"
        assert tape.since(lambda: catalog.remove_map("campus", 1, lambda: False), "COMMIT", "unlink", "fsync") == [
            "COMMIT catalog.sqlite",
            f"unlink {maps}/000001.sqlite",
            f"fsync {maps}",
        ]


def test_an_acknowledged_observation(tape: Tape, tmp_path: Path) -> None:
    with SessionStore.open(tmp_path) as store:
        assert committed_for_good(store._db.conn)
        session = store.create(SessionRecord(0, "a" * 32, "campus", 1, "0" * 64, {}, 1.0, 9.0, 0, None)).result()
        row = ObservedRow(1, 9.0, 1.0, None, np.array([1, 2], np.float32))

        def acknowledged() -> None:
            future = store.append(session.number, row, 2.0)
            future.add_done_callback(lambda _: tape.lines.append("acknowledged"))
            future.result()

        assert tape.since(acknowledged) == ["COMMIT sessions.sqlite", "acknowledged"]


def test_new_files_and_folders(tape: Tape, tmp_path: Path) -> None:
    for store in (Catalog, SessionStore):
        assert tape.since(lambda store=store: store.open(tmp_path).close(), "fsync") == ["fsync ."]
    with Catalog.open(tmp_path) as catalog:
        lines = tape.since(lambda: catalog.create_domain("campus", {}, False, [1]), "fsync", "COMMIT")
        assert lines == ["fsync domains/campus", "fsync domains", "fsync .", "COMMIT catalog.sqlite"]
        folder = "domains/campus/traverses"
        traverses: list[Traverse] = []
        lines = tape.since(lambda: traverses.append(Traverse.create(tmp_path, "campus", "a")), "fsync", "rename")
        assert lines == [f"fsync {folder}/a.new", f"rename {folder}/a.new {folder}/a.sqlite", f"fsync {folder}"]
        with traverses[0] as traverse:
            assert committed_for_good(traverse._db.conn)
        lines = tape.since(lambda: Traverse.delete(tmp_path, "campus", "a"), "fsync", "unlink")
        assert lines[-1] == f"fsync {folder}"
        assert f"unlink {folder}/a.sqlite" in lines
        lines = tape.since(lambda: catalog.delete_domain("campus"), "COMMIT", "rename", "fsync")
        grave = lines[1].split()[-1]
        assert lines == [
            "COMMIT catalog.sqlite",
            f"rename domains/campus {grave}",
            "fsync domains",
            "COMMIT catalog.sqlite",
        ]


def test_what_is_carried_elsewhere(tape: Tape, tmp_path: Path, add_map: AddMap) -> None:
    data_dir, backup, exported, restored = (tmp_path / name for name in ("data", "b.tar", "a.map", "there"))
    with Catalog.open(data_dir) as catalog:
        catalog.create_domain("campus", {}, False, [1, 2, 3])
        add_map(catalog)
        for act, file in (
            (lambda: export_map(catalog, "campus", 1, exported), "a.map"),
            (lambda: back_up(data_dir, backup, "1.0", lambda _: None), "b.tar"),
        ):
            lines = tape.since(act, "fsync", "link")
            part = lines[0].split()[1]
            assert lines == [f"fsync {part}", f"link {part} {file}", "fsync ."]
    lines = tape.since(lambda: restore(backup, restored, lambda _: None), "fsync", "rename")
    last_rename = max(n for n, line in enumerate(lines) if line.startswith("rename"))
    synced = {Path(line.split()[1]).name for line in lines[:last_rename] if line.startswith("fsync")}
    assert {"catalog.sqlite", "000001.sqlite", "maps", "campus", "domains"} <= synced
    assert lines[last_rename - 1 :] == [
        "rename there/.restoring/domains there/domains",
        "rename there/.restoring/catalog.sqlite there/catalog.sqlite",
        "fsync there",
        "fsync .",
    ]
