import shutil
import sqlite3
import threading
from pathlib import Path
from typing import Any

import pytest

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    DeepSimbadError,
    DomainDiffersError,
    InvalidInputError,
    LostActivationError,
    TraverseInUseError,
    UnavailableError,
    UnknownDomainError,
    UnknownJobError,
    UnknownMapVersionError,
)
from deepsimbad.store import durable
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_table import ANY
from deepsimbad.store.records import JobState, MapState
from deepsimbad.store.traverses import Traverse

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


def sealed(catalog: Catalog, domain: str = "campus") -> int:
    version = catalog.begin_map(domain, {"n_landmarks": 3})
    catalog.map_path(domain, version).write_bytes(b"map")
    catalog.seal_map(domain, version, "0" * 64, 3, {"anr": 5.0})
    return version


def test_a_domain_is_made_once_and_kept(catalog: Catalog) -> None:
    record, created = catalog.create_domain("campus", {"b": 1, "a": [2]}, True, [1, 2.5])
    assert created
    assert (record.name, record.closed, record.actions_m, record.active_version) == ("campus", True, (1.0, 2.5), None)
    assert catalog.create_domain("campus", {"a": [2], "b": 1}, True, (1.0, 2.5)) == (record, False)
    for other in (({"b": 2}, True, [1, 2.5]), ({"b": 1, "a": [2]}, False, [1, 2.5]), ({"b": 1, "a": [2]}, True, [1])):
        with pytest.raises(DomainDiffersError):
            catalog.create_domain("campus", *other)
    catalog.close()
    with Catalog.open(catalog.data_dir) as again:
        assert again.domain("campus") == record
        assert again.domains() == [record]


def test_unknown_and_impossible_names(campus: Catalog) -> None:
    for name in ("city", "../campus", "\ud800", "", "campus' OR '1'='1"):
        with pytest.raises(UnknownDomainError):
            campus.domain(name)
        for act in (campus.maps, campus.jobs, campus.delete_domain, lambda d: campus.begin_map(d, {})):
            with pytest.raises(UnknownDomainError):
                act(name)
    for name in ("../campus", "\ud800", ""):
        with pytest.raises(InvalidInputError):
            campus.create_domain(name, EVALUATOR, False, [1])
    with pytest.raises(InvalidInputError):
        campus.create_domain("city", {"x": float("nan")}, False, [1])
    assert [record.name for record in campus.domains()] == ["campus"]


def test_a_deleted_domain_takes_everything_with_it(campus: Catalog) -> None:
    sealed(campus)
    job = campus.create_job("campus", "remap", {})
    Traverse.create(campus.data_dir, "campus", "summer").close()
    with pytest.raises(TraverseInUseError):
        campus.delete_domain("campus")
    campus.update_job(job.job_id, state="succeeded")
    campus.delete_domain("campus")
    with pytest.raises(UnknownDomainError):
        campus.domain("campus")
    with pytest.raises(UnknownJobError):
        campus.job(job.job_id)
    assert list((campus.data_dir / "domains").iterdir()) == []
    campus.create_domain("campus", EVALUATOR, False, [1])
    assert Traverse.list(campus.data_dir, "campus") == []
    assert campus.maps("campus") == []


def test_files_of_an_unknown_domain_are_not_adopted(catalog: Catalog) -> None:
    stray = catalog.data_dir / "domains/campus/maps/000001.sqlite"
    stray.parent.mkdir(parents=True)
    stray.write_bytes(b"someone's map")
    with pytest.raises(ConflictError):
        catalog.create_domain("campus", EVALUATOR, False, [1])
    assert catalog.domains() == []
    assert catalog.discard_unfinished() == []
    assert stray.exists()


def test_versions_count_up_and_are_never_used_again(campus: Catalog) -> None:
    assert campus.begin_map("campus", {"seed": 1}) == 1
    assert campus.map("campus", 1).state is MapState.BUILDING
    campus.discard_map("campus", 1)
    version = sealed(campus)
    assert version == 2
    record = campus.map("campus", 2)
    assert (record.state, record.file_bytes, record.metrics) == (MapState.SEALED, 3, {"anr": 5.0})
    assert [record.version for record in campus.maps("campus")] == [2]
    for missing in (1, 3, 0, -1, 2**70):
        with pytest.raises(UnknownMapVersionError):
            campus.map("campus", missing)
    with pytest.raises(UnknownMapVersionError):
        campus.discard_map("campus", 2)
    assert campus.map_path("campus", 2).exists()
    with pytest.raises(UnknownMapVersionError):
        campus.seal_map("campus", 2, "0" * 64, 3, {})


def test_a_version_without_its_file_is_not_sealed(campus: Catalog) -> None:
    version = campus.begin_map("campus", {})
    with pytest.raises(DamagedMapError):
        campus.seal_map("campus", version, "0" * 64, 3, {})
    campus.map_path("campus", version).write_bytes(b"four")
    with pytest.raises(DamagedMapError):
        campus.seal_map("campus", version, "0" * 64, 3, {})
    assert campus.map("campus", version).state is MapState.BUILDING


def test_activation_is_a_compare_and_swap(campus: Catalog) -> None:
    first, second = sealed(campus), sealed(campus)
    building = campus.begin_map("campus", {})
    with pytest.raises(UnknownMapVersionError):
        campus.activate("campus", building, ANY)
    with pytest.raises(LostActivationError, match="serves no map, not map version 2"):
        campus.activate("campus", first, second)
    assert campus.domain("campus").active_version is None
    campus.activate("campus", first, None)
    with pytest.raises(LostActivationError) as caught:
        campus.activate("campus", second, None)
    assert caught.value.hints == {"active": first, "expected": None}
    campus.activate("campus", second, first)
    assert campus.domain("campus").active_version == second
    assert [record.state for record in campus.maps("campus")][:2] == [MapState.RETIRED, MapState.ACTIVE]
    campus.activate("campus", first, second)  # roll back
    campus.activate("campus", first, first)  # the same again
    campus.activate("campus", second, ANY)
    assert campus.domain("campus").active_version == second


def test_of_many_swaps_at_once_one_wins(campus: Catalog) -> None:
    versions = [sealed(campus) for _ in range(8)]
    won: list[int] = []
    lost: list[LostActivationError] = []
    start = threading.Barrier(len(versions))

    def swap(version: int) -> None:
        with Catalog.open(campus.data_dir) as own:  # a connection of its own, as another process has
            start.wait()
            try:
                own.activate("campus", version, None)
                won.append(version)
            except LostActivationError as error:
                lost.append(error)

    threads = [threading.Thread(target=swap, args=[version]) for version in versions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert len(lost) == len(versions) - 1
    assert campus.domain("campus").active_version == won[0]


def test_many_threads_take_different_versions(campus: Catalog) -> None:
    taken: list[int] = []
    threads = [
        threading.Thread(target=lambda: taken.extend(campus.begin_map("campus", {}) for _ in range(5)))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == list(range(1, 21))


def test_the_life_of_a_job(campus: Catalog) -> None:
    job = campus.create_job("campus", "remap", {"seed": 3})
    assert (job.state, job.progress, job.stage, job.started_at) == (JobState.QUEUED, 0.0, None, None)
    job = campus.update_job(job.job_id, state="running", stage="select landmarks", progress=0.25, eta_s=12.5)
    assert (job.state, job.progress, job.stage, job.eta_s) == (JobState.RUNNING, 0.25, "select landmarks", 12.5)
    assert job.started_at is not None
    assert job.finished_at is None
    assert campus.update_job(job.job_id, eta_s=float("inf")).eta_s is None
    done = campus.update_job(job.job_id, state=JobState.CANCELLED, error={"code": "cancelled"})
    assert done.finished_at is not None
    assert done.error == {"code": "cancelled"}
    late = campus.update_job(job.job_id, state="running", progress=0.9)
    assert late == done == campus.job(job.job_id)
    second = campus.create_job("campus", "remap", {})
    assert [record.job_id for record in campus.jobs()] == [job.job_id, second.job_id]
    assert campus.jobs("campus") == campus.jobs()


@pytest.mark.parametrize(
    "fields", [{"owner": "x"}, {"created_at": "x"}, {"state": "dancing"}, {"progress": 1.5}, {"progress": float("nan")}]
)
def test_a_job_refuses_what_cannot_be(campus: Catalog, fields: dict[str, object]) -> None:
    job = campus.create_job("campus", "remap", {})
    with pytest.raises(InvalidInputError):
        campus.update_job(job.job_id, **fields)
    assert campus.job(job.job_id) == job


@pytest.mark.parametrize("job_id", ["", "x", "0" * 32, "\ud800", "' OR 1=1 --"])
def test_an_unknown_job(campus: Catalog, job_id: str) -> None:
    with pytest.raises(UnknownJobError):
        campus.job(job_id)
    with pytest.raises(UnknownJobError):
        campus.update_job(job_id, progress=0.5)


def test_a_catalog_that_cannot_be_used_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(UnavailableError) as caught:
        Catalog.open(tmp_path / "file" / "data")
    assert caught.value.hints["reason"] == "io_error"
    garbage = tmp_path / "garbage"
    garbage.mkdir()
    (garbage / "catalog.sqlite").write_bytes(b"this is no database at all" * 100)
    with pytest.raises(DamagedFileError):
        Catalog.open(garbage)
    catalog = Catalog.open(tmp_path / "data")
    catalog.close()
    with pytest.raises(UnavailableError) as caught:
        catalog.domains()
    assert caught.value.hints["reason"] == "closed"


def read_everything(data_dir: Path) -> None:
    with Catalog.open(data_dir) as catalog:
        catalog.domains()
        catalog.maps("campus")
        catalog.jobs()


def test_a_damaged_catalog_gives_named_errors_alone(campus: Catalog) -> None:
    sealed(campus)
    campus.create_job("campus", "remap", {"a": 1})
    campus.close()
    path = campus.data_dir / "catalog.sqlite"
    whole = path.read_bytes()
    n_named = 0
    for at in [*range(0, 100, 3), *range(100, len(whole), 307)]:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            read_everything(campus.data_dir)
        except DeepSimbadError:
            n_named += 1
        for suffix in ("-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
    assert n_named > 20
    for length in [0, 1, 511, *range(4096, len(whole), 4096)]:
        path.write_bytes(whole[:length])
        with pytest.raises(DamagedFileError):
            read_everything(campus.data_dir)


def test_a_lost_catalog_is_not_silently_made_anew(campus: Catalog) -> None:
    campus.close()
    (campus.data_dir / "catalog.sqlite").unlink()
    with pytest.raises(DamagedFileError, match="put a copy"):
        Catalog.open(campus.data_dir)


def test_the_catalog_is_plain_sqlite_with_its_rules_inside(campus: Catalog) -> None:
    sealed(campus)
    with sqlite3.connect(campus.data_dir / "catalog.sqlite") as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        for statement in (
            "UPDATE map SET state = 'lost'",
            "UPDATE map SET sha256 = NULL",
            "UPDATE domain SET closed = 2",
            "INSERT INTO job (job_id, domain, kind, config, state, owner, created_at)"
            " VALUES ('a', 'nowhere', '', '', 'queued', '', '')",
        ):
            with pytest.raises(sqlite3.IntegrityError):
                connection.execute(statement)
    connection.close()


def test_who_reads_does_not_wait_for_who_writes(campus: Catalog) -> None:
    writing, done = threading.Event(), threading.Event()

    def write() -> None:
        with campus._writing() as db:
            db.execute("UPDATE domain SET closed = 1")
            writing.set()
            done.wait(60)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        assert writing.wait(60)
        assert [record.closed for record in campus.domains()] == [False]
        assert campus.keys() == []
    finally:
        done.set()
        thread.join()
    assert campus.domain("campus").closed


def test_others_write_while_the_files_of_a_deleted_domain_go(campus: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    remove = shutil.rmtree

    def slowly(path: Path, **how: Any) -> None:
        monkeypatch.setattr(durable.shutil, "rmtree", remove)
        with Catalog.open(campus.data_dir) as other:
            other.create_domain("meanwhile", EVALUATOR, False, [1])
            other.create_domain("campus", EVALUATOR, True, [1])
        remove(path, **how)

    monkeypatch.setattr(durable.shutil, "rmtree", slowly)
    campus.delete_domain("campus")
    assert {record.name for record in campus.domains()} == {"campus", "meanwhile"}
    assert not list(campus.data_dir.glob("domains/.removing-*"))


def test_a_settled_map_waits_for_a_removal_under_way(campus: Catalog) -> None:
    """Who pins a version and then finds it here keeps it: so it must not look while it is being removed."""
    sealed(campus)
    campus.activate("campus", sealed(campus), ANY)
    asked, go_on = threading.Event(), threading.Event()
    found: list[bool] = []

    def is_pinned() -> bool:
        asked.set()
        assert go_on.wait(60)
        return False

    removing = threading.Thread(target=lambda: campus.remove_map("campus", 1, is_pinned))
    removing.start()
    assert asked.wait(60)
    looking = threading.Thread(target=lambda: found.append(campus.settled_map("campus", 1).removed_at is not None))
    looking.start()
    assert campus.map("campus", 1).removed_at is None  # a plain look does not wait
    go_on.set()
    removing.join()
    looking.join()
    assert found == [True]
