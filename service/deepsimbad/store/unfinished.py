"""What a crash leaves behind, and how it is cleared away. Every function stands inside a write transaction."""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from sqlite_utils import Database

from deepsimbad.errors import JobInterruptedError
from deepsimbad.store import domain_table, job_queue, job_table, layout, map_table, ownership, traverses
from deepsimbad.store.durable import remove_database
from deepsimbad.store.records import JobState, MapState

SEALING_SUFFIX = ".sealing"
MAX_STARTS = 3  # of a job whose service died each time: it may be what kills it
_MAP_FILE = re.compile(r"(\d{6,})\.(sqlite|building|sealing)(?:-journal|-wal|-shm)?")


def take_over_abandoned_jobs(db: Database, owners: Path, owner: Callable[[], str]) -> Iterator[str]:
    """Let the queued and running jobs of dead processes wait again; one that died at every start fails.

    Args:
        db: The catalog.
        owners: The folder of lock files.
        owner: Gives the mark of this process; asked only where there is such a job.
    """
    for job_id, before in job_table.unfinished(db):
        if ownership.is_alive(owners, before):
            continue
        job = job_table.get(db, job_id)
        if job.state is JobState.RUNNING and job.n_starts >= MAX_STARTS:
            error = {
                "code": JobInterruptedError.code,
                "message": f"it was started {job.n_starts} times and the service died each time",
                "n_starts": job.n_starts,
            }
            job_table.update(db, job_id, {"state": JobState.FAILED, "error": error, "eta_s": None})
            yield f"job {job_id} failed: {error['message']}"
        else:
            job_queue.take_over(db, job_id, owner())
            yield f"job {job_id} was interrupted and waits again"


def discard_abandoned_maps(db: Database, data_dir: Path, owners: Path) -> Iterator[str]:
    """Discard the maps that dead processes were building, files first."""
    for domain, version, owner in map_table.building(db):
        if not ownership.is_alive(owners, owner):
            remove_map_files(data_dir, domain, version)
            map_table.delete(db, domain, version)
            yield f"discarded the unfinished map {version} of domain {domain}"
    ownership.sweep(owners)


def remove_orphans(db: Database, data_dir: Path) -> Iterator[str]:
    """Remove the files of known domains that no map version or traverse owns.

    Folders of unknown domains are left alone, unless they are empty: a lost catalog never empties them. The write lock
    keeps new versions from appearing meanwhile.
    """
    for domain in domain_table.all_domains(db):
        folder = layout.maps_folder(data_dir, domain.name)
        records = {record.version: record for record in map_table.of_domain(db, domain.name)}
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            match = _MAP_FILE.fullmatch(path.name)
            if match is None:
                continue
            record = records.get(int(match[1]))
            is_building = record is not None and record.state is MapState.BUILDING
            is_kept = record is not None and record.removed_at is None
            if not (is_kept if match[2] == "sqlite" else is_building):
                path.unlink(missing_ok=True)
                yield f"removed {path.name} of domain {domain.name}, which no map version owns"
        for name in traverses.remove_leftovers(data_dir, domain.name):
            yield f"removed {name} of domain {domain.name}, which no traverse owns"
    known = {domain.name for domain in domain_table.all_domains(db)}
    folder = layout.domains_folder(data_dir)
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.name not in known and layout.is_name(path.name) and _is_empty(path):
            shutil.rmtree(path)
            yield f"removed the empty folder {path.name}, which no domain owns"


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and all(path.is_dir() and not path.is_symlink() for path in folder.rglob("*"))


def remove_map_files(data_dir: Path, domain: str, version: int) -> None:
    """Remove everything that building a version may have written."""
    path = layout.map_path(data_dir, domain, version)
    for file in (layout.building_path(data_dir, domain, version), path.with_suffix(SEALING_SUFFIX), path):
        remove_database(file)
