"""Jobs run one after the other, and their rows tell the truth."""

import threading
import time
from contextlib import contextmanager

import pytest

from deepsimbad.errors import IdempotencyKeyReusedError, JobInterruptedError, UnavailableError
from deepsimbad.jobs.remap_config import RemapConfig
from deepsimbad.jobs.runner import InThisProcess, JobRunner
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobState

from .conftest import DOMAIN

WITHIN_S = 120
CONFIG = RemapConfig("drive", "other", n_landmarks=8)
ANOTHER = RemapConfig("drive", "other", n_landmarks=7)

pytestmark = pytest.mark.usefixtures("two_drives")


class Gate:
    """Does jobs in this process, each once it is let through."""

    def __init__(self, data_dir):
        self.entered, self.open = threading.Event(), threading.Event()
        self.run_job = InThisProcess(data_dir)

    def __call__(self, job, on_progress, is_cancelled):
        self.entered.set()
        assert self.open.wait(WITHIN_S)
        return self.run_job(job, on_progress, is_cancelled)


@pytest.fixture
def gate(catalog):
    return Gate(catalog.data_dir)


@contextmanager
def running(catalog, run_job=None, on_activated=lambda domain: None):
    runner = JobRunner(catalog, run_job or InThisProcess(catalog.data_dir), on_activated)
    try:
        yield runner
    finally:
        runner.close()


def ended_job(catalog, job_id):
    give_up = time.monotonic() + WITHIN_S
    while time.monotonic() < give_up:
        job = catalog.job(job_id)
        if job.state not in {JobState.QUEUED, JobState.RUNNING}:
            return job
        time.sleep(0.01)
    raise AssertionError(f"job {job_id} did not end: {job}")


def close_while_one_runs(runner, gate):
    """Ask the runner to end, and let the job through that it waits for."""
    closing = threading.Thread(target=runner.close)
    closing.start()
    assert runner._closing.wait(WITHIN_S)
    gate.open.set()
    closing.join(WITHIN_S)
    assert not closing.is_alive()


def test_a_job_of_one_id_is_made_once_whoever_asks_and_whenever(catalog, gate):
    first_id, second_id, job_ids = "a" * 32, "b" * 32, []
    runner = JobRunner(catalog, gate, lambda domain: None, max_waiting=1)
    try:
        first = runner.submit(DOMAIN, CONFIG, first_id)
        assert gate.entered.wait(WITHIN_S)
        all_at_once = threading.Barrier(8)

        def ask():
            all_at_once.wait(WITHIN_S)
            job_ids.append(runner.submit(DOMAIN, CONFIG, second_id).job_id)

        asking = [threading.Thread(target=ask) for _ in range(8)]
        for thread in asking:
            thread.start()
        for thread in asking:
            thread.join(WITHIN_S)
        assert job_ids == [second_id] * 8, "one alone finds room to wait; the others find that one"
        with pytest.raises(IdempotencyKeyReusedError):
            runner.submit(DOMAIN, ANOTHER, first_id)
        gate.open.set()
        ended_job(catalog, second_id)
    finally:
        gate.open.set()
        runner.close()
    assert runner.submit(DOMAIN, CONFIG, first_id).state is JobState.SUCCEEDED, "nothing new is asked of it"
    with running(catalog) as again:
        job = again.submit(DOMAIN, CONFIG, first_id)
        assert (job.job_id, job.created_at, job.result["map_version"]) == (first_id, first.created_at, 1)
        with pytest.raises(IdempotencyKeyReusedError):
            again.submit(DOMAIN, ANOTHER, first_id)
    assert [record.version for record in catalog.maps(DOMAIN)] == [1, 2]


def test_a_job_that_meets_damage_says_in_which_traverse(catalog):
    path = catalog.data_dir / "domains" / DOMAIN / "traverses" / "other.sqlite"
    path.write_bytes(b"no database" * 1000)
    with running(catalog) as runner:
        job = ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id)
    assert (job.state, job.error["code"], job.error["file"]) == (JobState.FAILED, "damaged_file", "other.sqlite")
    assert job.error["message"].startswith("other.sqlite is damaged")


def test_a_running_job_is_cancelled_at_its_next_report_and_leaves_no_map(catalog, gate):
    with running(catalog, gate) as runner:
        job = runner.submit(DOMAIN, CONFIG)
        assert gate.entered.wait(WITHIN_S)
        runner.cancel(job.job_id)
        gate.open.set()
        job = ended_job(catalog, job.job_id)
        assert (job.state, job.error["code"], catalog.maps(DOMAIN)) == (JobState.CANCELLED, "cancelled", [])
        assert ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id).state is JobState.SUCCEEDED, "it goes on"


def test_a_job_that_breaks_tells_no_inner_detail_and_the_runner_goes_on(catalog, caplog):
    outcomes = [ZeroDivisionError("secret"), None]

    def run_job(*job):
        if error := outcomes.pop(0):
            raise error
        return InThisProcess(catalog.data_dir)(*job)

    with running(catalog, run_job) as runner:
        job, next_job = (ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id) for _ in range(2))
    assert (job.state, job.error["code"], next_job.state) == (JobState.FAILED, "internal_error", JobState.SUCCEEDED)
    assert "secret" not in str(job.error)
    assert "secret" in caplog.text, "the log has it"


def test_closing_leaves_what_runs_and_what_waits_to_the_next_service(catalog, gate):
    runner = JobRunner(catalog, gate, lambda domain: None)
    first, second = (runner.submit(DOMAIN, CONFIG) for _ in range(2))
    assert gate.entered.wait(WITHIN_S)
    close_while_one_runs(runner, gate)
    stopped = catalog.job(first.job_id)
    assert (stopped.state, stopped.n_starts, stopped.stage) == (JobState.QUEUED, 0, None)
    assert (catalog.job(second.job_id).state, catalog.maps(DOMAIN)) == (JobState.QUEUED, [])
    with pytest.raises(UnavailableError, match="shutting down"):
        runner.submit(DOMAIN, CONFIG)
    data_dir = catalog.data_dir
    catalog.close()
    with Catalog.open(data_dir) as again:
        assert again.discard_unfinished() == []
        with running(again):
            assert [ended_job(again, job.job_id).result["map_version"] for job in (first, second)] == [1, 2]
        assert again.discard_unfinished() == []


def test_a_job_that_was_cancelled_as_the_service_stops_stays_cancelled(catalog, gate):
    runner = JobRunner(catalog, gate, lambda domain: None)
    job = runner.submit(DOMAIN, CONFIG)
    assert gate.entered.wait(WITHIN_S)
    runner.cancel(job.job_id)
    close_while_one_runs(runner, gate)
    assert catalog.job(job.job_id).state is JobState.CANCELLED


@pytest.mark.parametrize("is_before", [True, False], ids=["before its last step", "behind it"])
def test_a_job_whose_process_died_has_succeeded_if_its_map_is_there_and_leaves_no_half_map(catalog, is_before):
    def run_job(job, on_progress, is_cancelled):
        if not is_before:
            InThisProcess(catalog.data_dir)(job, on_progress, is_cancelled)
        with Catalog.open(catalog.data_dir) as child:
            version = child.begin_map(DOMAIN, {})
            child.building_path(DOMAIN, version).write_bytes(b"half a map")
        raise JobInterruptedError("the job's process was ended by SIGKILL", signal="SIGKILL")

    activated = []
    with running(catalog, run_job, activated.append) as runner:
        job = ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id)
    if is_before:
        assert job.state is JobState.FAILED
        assert (job.error["code"], job.error["signal"]) == ("job_interrupted", "SIGKILL")
    else:
        assert (job.state, job.result["map_version"], job.error) == (JobState.SUCCEEDED, 1, None)
    assert [record.version for record in catalog.maps(DOMAIN)] == ([] if is_before else [1])
    assert activated == ([] if is_before else [DOMAIN])
    assert list(catalog.map_path(DOMAIN, 1).parent.glob("*.building")) == []
