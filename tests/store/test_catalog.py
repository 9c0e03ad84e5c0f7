"""What the catalog keeps, refuses and clears away: domains, map versions, jobs, keys."""

import re
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack, suppress
from datetime import datetime, timedelta
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import pytest

from deepsimbad.errors import (
    ConflictError,
    DamagedFileError,
    DamagedMapError,
    DeepSimbadError,
    InvalidInputError,
    LostActivationError,
    TraverseInUseError,
    UnavailableError,
    UnknownDomainError,
    UnknownJobError,
    UnknownKeyError,
    UnknownMapVersionError,
)
from deepsimbad.store import durable
from deepsimbad.store.catalog import ApiKey, Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.records import JobState, KeyScope, MapState, current_moment
from deepsimbad.store.traverses import Traverse

from .conftest import EVALUATOR, at_once


def sealed(catalog: Catalog, domain: str = "campus") -> int:
    version = catalog.begin_map(domain, {"n_landmarks": 3})
    catalog.map_path(domain, version).write_bytes(b"map")
    catalog.seal_map(domain, version, "0" * 64, 3, {"anr": 5.0})
    return version


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
    version = campus.begin_map("campus", {})
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
    rolled_back = campus.activate("campus", first, second)
    assert campus.activate("campus", first, first) == rolled_back, "the same again changes nothing, its times neither"
    campus.activate("campus", second, ANY)
    assert campus.domain("campus").active_version == second


def test_which_map_served_last_is_known_though_the_clock_was_set_back(
    campus: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Earlier(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:
            return datetime.now(tz) - timedelta(days=400)

    first, second = sealed(campus), sealed(campus)
    campus.activate("campus", first, None)
    campus.activate("campus", second, first)
    monkeypatch.setattr("deepsimbad.store.records.datetime", Earlier)
    campus.activate("campus", first, second)
    retired_at = {record.version: record.retired_at or "" for record in campus.maps("campus")}
    assert retired_at[second] > retired_at[first]


def test_of_many_swaps_at_once_one_wins(campus: Catalog) -> None:
    def wins(catalog: Catalog, version: int) -> bool:
        with suppress(LostActivationError):
            return catalog.activate("campus", version, None).version == version
        return False

    versions = [sealed(campus) for _ in range(8)]
    with ExitStack() as stack:  # a connection each, as other processes have
        catalogs = [stack.enter_context(Catalog.open(campus.data_dir)) for _ in versions]
        won = at_once([partial(wins, *pair) for pair in zip(catalogs, versions, strict=True)])
    assert list(compress(versions, won)) == [campus.domain("campus").active_version]


def test_the_life_of_a_job(campus: Catalog) -> None:
    job = campus.create_job("campus", "remap", {"seed": 3})
    assert (job.state, job.progress, job.stage, job.started_at) == (JobState.QUEUED, 0.0, None, None)
    job = campus.update_job(job.job_id, state="running", stage="describe", progress=0.25, eta_s=12.5)
    assert (job.state, job.progress, job.stage, job.eta_s) == (JobState.RUNNING, 0.25, "describe", 12.5)
    assert job.started_at is not None
    assert job.finished_at is None
    assert campus.update_job(job.job_id, eta_s=float("inf")).eta_s is None
    cancelled_job = campus.update_job(job.job_id, state=JobState.CANCELLED, error={"code": "cancelled"})
    assert cancelled_job.finished_at is not None
    assert cancelled_job.error == {"code": "cancelled"}
    late_job = campus.update_job(job.job_id, state="running", progress=0.9)
    assert late_job == cancelled_job == campus.job(job.job_id)
    second = campus.create_job("campus", "remap", {})
    assert [record.job_id for record in campus.jobs()] == [job.job_id, second.job_id]
    assert campus.jobs("campus") == campus.jobs()


def test_jobs_of_two_catalogs_are_one_list_in_the_order_of_their_making(
    campus: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Catalog.open(tmp_path / "other") as other:
        other.create_domain("city", EVALUATOR, False, [1])
        job_ids = []
        for catalog, domain in 2 * [(campus, "campus"), (other, "city")]:
            job_ids.append(catalog.create_job(domain, "remap", {}).job_id)
        numbered_jobs = [*campus.numbered_jobs(None, None, 9), *other.numbered_jobs(None, None, 9)]
        assert [job.job_id for _, job in sorted(numbered_jobs, key=lambda entry: entry[0])] == job_ids
    monkeypatch.setattr("time.time", lambda: 0.0)  # a clock that was set back
    last = campus.create_job("campus", "remap", {}).job_id
    assert campus.newest_jobs(None, None, 1).records[0].job_id == campus.waiting_jobs()[-1] == last


def test_a_catalog_that_cannot_be_used_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(UnavailableError) as caught:
        Catalog.open(tmp_path / "file" / "data")
    assert caught.value.hints["reason"] == "no_folder"
    garbage = tmp_path / "garbage"
    garbage.mkdir()
    (garbage / "catalog.sqlite").write_bytes(b"this is no database at all" * 100)
    with pytest.raises(DamagedFileError):
        Catalog.open(garbage)
    (garbage / "catalog.sqlite").unlink()
    (garbage / "domains" / "campus").mkdir(parents=True)
    with pytest.raises(DamagedFileError, match="put a copy"):
        Catalog.open(garbage)  # a lost one is not silently made anew
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
    content = path.read_bytes()
    n_named = 0
    for at in [*range(0, 100, 3), *range(100, len(content), 307)]:
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :])
        try:
            read_everything(campus.data_dir)
        except DeepSimbadError:
            n_named += 1
        for suffix in ("-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
    assert n_named > 20
    for length in [0, 1, 511, *range(4096, len(content), 4096)]:
        path.write_bytes(content[:length])
        with pytest.raises(DamagedFileError):
            read_everything(campus.data_dir)


def test_a_catalog_that_was_removed_meanwhile_takes_no_more(campus: Catalog) -> None:
    campus.domains()
    (campus.data_dir / "catalog.sqlite").unlink()
    with pytest.raises(DamagedFileError, match="was removed under the running service"):
        campus.create_domain("more", EVALUATOR, False, [1])
    assert [record.name for record in campus.domains()] == ["campus"], "who reads is answered"
    with pytest.raises(DamagedFileError, match="was removed"):
        campus.check()


def test_who_reads_does_not_wait_for_who_writes(campus: Catalog) -> None:
    writing, end = threading.Event(), threading.Event()

    def write() -> None:
        with campus._writing() as db:
            db.execute("UPDATE domain SET closed = 1")
            writing.set()
            end.wait(60)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        assert writing.wait(60)
        assert [record.closed for record in campus.domains()] == [False]
        assert campus.keys() == []
    finally:
        end.set()
        thread.join()
    assert campus.domain("campus").closed


def test_a_domain_that_holds_files_of_any_kind_is_not_empty(campus: Catalog) -> None:
    encoded = campus.data_dir / "domains/campus/encoding/0.npy"  # frames that `deepsimbad ray map` goes on from
    encoded.parent.mkdir()
    encoded.touch()
    campus.delete_domain("campus", only_empty=True)
    assert encoded.exists()
    encoded.unlink()
    campus.delete_domain("campus", only_empty=True)
    assert campus.domains() == []


def test_others_write_while_the_files_of_a_deleted_domain_go(campus: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    remove = shutil.rmtree

    def slowly(path: Path, **options: Any) -> None:
        monkeypatch.setattr(durable.shutil, "rmtree", remove)
        with Catalog.open(campus.data_dir) as other:
            other.create_domain("meanwhile", EVALUATOR, False, [1])
            other.create_domain("campus", EVALUATOR, True, [1])
        remove(path, **options)

    monkeypatch.setattr(durable.shutil, "rmtree", slowly)
    campus.delete_domain("campus")
    assert {record.name for record in campus.domains()} == {"campus", "meanwhile"}
    assert not list(campus.data_dir.glob("domains/.removing-*"))


def test_a_settled_map_waits_for_a_removal_under_way(campus: Catalog) -> None:
    """Who pins a version and then finds it here keeps it: so it must not look while it is being removed."""
    sealed(campus)
    campus.activate("campus", sealed(campus), ANY)
    question, go_on = threading.Event(), threading.Event()
    is_removed: list[bool] = []

    def is_pinned() -> bool:
        question.set()
        assert go_on.wait(60)
        return False

    removing = threading.Thread(target=lambda: campus.remove_map("campus", 1, is_pinned))
    removing.start()
    assert question.wait(60)
    looking = threading.Thread(target=lambda: is_removed.append(campus.settled_map("campus", 1).removed_at is not None))
    looking.start()
    assert campus.map("campus", 1).removed_at is None  # a plain look does not wait
    go_on.set()
    removing.join()
    looking.join()
    assert is_removed == [True]


def test_a_key_is_kept_without_its_secret(catalog: Catalog) -> None:
    record, key = catalog.create_key(KeyScope.ADMIN, "the operator")
    assert re.fullmatch(r"dsk_[0-9a-f]{12}_[A-Za-z0-9_-]{43}", key.text)
    assert ApiKey.parse(key.text) == key
    assert record.key_id == key.key_id
    assert (record.name, record.scope, record.secret_sha256) == ("the operator", KeyScope.ADMIN, key.secret_sha256)
    assert (record.expires_at, record.revoked_at) == (None, None)
    assert catalog.keys() == [record]
    assert key.secret not in repr(key)
    catalog.close()
    for path in catalog.data_dir.iterdir():
        if path.is_file():
            assert key.secret.encode() not in path.read_bytes(), path.name


def test_a_revoked_key_stays_in_the_list(catalog: Catalog) -> None:
    record, _ = catalog.create_key(KeyScope.LOCALIZE, lifetime=timedelta(days=2))
    assert record.expires_at is not None
    assert record.is_usable(current_moment())
    assert not record.is_usable(record.expires_at)
    for unknown in ("0123456789ab", "", "\ud800", "' OR 1=1 --"):
        with pytest.raises(UnknownKeyError):
            catalog.revoke_key(unknown)
    revoked = catalog.revoke_key(record.key_id)
    assert revoked.revoked_at is not None
    assert not revoked.is_usable(current_moment())
    assert catalog.revoke_key(record.key_id) == revoked
    assert catalog.keys() == [revoked]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "dsk_",
        "dsk_0123456789ab_",
        "dsk_0123456789AB_" + "a" * 43,
        "dsk_0123456789ab_" + "a" * 42 + "\n",
        "dsk_0123456789ab_" + "a" * 44,
        "dsk_0123456789ab_" + "a" * 42 + "ä",
        " dsk_0123456789ab_" + "a" * 43,
    ],
)
def test_other_text_is_no_key(text: str) -> None:
    assert ApiKey.parse(text) is None


# What a crash leaves behind

CHILD = """
import sys
from pathlib import Path
from deepsimbad.store.catalog import Catalog
catalog = Catalog.open(Path(sys.argv[1]))
version = catalog.begin_map("campus", {})
catalog.building_path("campus", version).write_bytes(b"half a map")
catalog.map_path("campus", version).write_bytes(b"renamed, not yet in the catalog")
print(version, flush=True)
sys.stdin.read()
"""


def test_only_the_maps_of_dead_processes_are_discarded(campus: Catalog) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(campus.data_dir)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        version = int(child.stdout.readline())
        assert campus.discard_unfinished() == []
        assert campus.map("campus", version).state is MapState.BUILDING
        with pytest.raises(TraverseInUseError):
            campus.delete_domain("campus")
        child.send_signal(signal.SIGKILL)
    own_version = campus.begin_map("campus", {})
    assert campus.discard_abandoned_maps() == [], "while anybody builds one of the domain nobody can tell"
    campus.discard_map("campus", own_version)
    assert campus.discard_unfinished() == [f"discarded the unfinished map {version} of domain campus"]
    assert campus.maps("campus") == []
    assert list((campus.data_dir / "domains/campus/maps").iterdir()) == []
    assert campus.discard_unfinished() == []


@pytest.mark.parametrize(("n_starts", "state"), [(1, JobState.QUEUED), (2, JobState.QUEUED), (3, JobState.FAILED)])
def test_a_job_is_started_three_times_at_most(campus: Catalog, n_starts: int, state: JobState) -> None:
    waits, runs = (campus.create_job("campus", "remap", {}).job_id for _ in range(2))
    for _ in range(n_starts - 1):
        campus.start_job(runs)
        campus.take_over_jobs()
    campus.start_job(runs)
    campus.update_job(runs, stage="train", progress=0.5, eta_s=9)
    with pytest.raises(TraverseInUseError):
        campus.delete_domain("campus")
    (line,) = campus.discard_unfinished()
    assert runs in line
    job = campus.job(runs)
    assert (job.state, job.n_starts, job.eta_s) == (state, n_starts, None)
    if state is JobState.FAILED:
        message = "it was started 3 times and the service died each time"
        assert job.error == {"code": "job_interrupted", "message": message, "n_starts": 3}
        assert job.finished_at is not None
    else:
        assert (job.stage, job.progress, job.error, job.finished_at) == (None, 0, None, None)
    assert campus.waiting_jobs() == ([waits, runs] if state is JobState.QUEUED else [waits])
    assert campus.discard_unfinished() == []


def test_a_clean_stop_counts_as_no_start(campus: Catalog) -> None:
    job_id = campus.create_job("campus", "remap", {}).job_id
    started_at = campus.start_job(job_id).started_at
    campus.update_job(job_id, stage="train", progress=0.4, eta_s=3)
    job = campus.give_back_job(job_id)
    assert (job.state, job.n_starts, job.stage, job.progress, job.eta_s) == (JobState.QUEUED, 0, None, 0, None)
    assert campus.give_back_job(job_id) == job, "only what runs is given back"
    assert campus.start_job(job_id).started_at == started_at, "when work first began"
    assert campus.start_job(job_id).n_starts == 1, "it runs already"


def test_a_deletion_that_was_cut_short_is_finished(campus: Catalog) -> None:
    folder = campus.data_dir / "domains/campus"
    stale = folder / "traverses/summer.sqlite"

    def cut_short() -> None:
        stale.write_bytes(b"old frames")
        with campus._writing() as db:  # the crash comes between the two transactions of delete_domain
            db.execute("DELETE FROM domain")
            db.execute("INSERT INTO doomed_folder VALUES ('campus')")

    cut_short()
    assert campus.discard_unfinished() == ["removed the folder of the deleted domain campus"]
    assert not folder.exists()
    assert campus.discard_unfinished() == []
    campus.create_domain("campus", {}, False, [1])
    cut_short()
    campus.create_domain("campus", {}, False, [1])  # does not inherit what was to go
    assert campus.discard_unfinished() == []
    assert (stale.exists(), stale.parent.is_dir()) == (False, True)
    sealed(campus)
    with campus._writing() as db:  # of a map, before its file is unlinked
        db.execute("UPDATE map SET state = 'retired', removed_at = ?", [current_moment()])
    assert campus.discard_unfinished() == ["removed the file of the removed map 1 of domain campus"]
    assert not campus.map_path("campus", 1).exists()
