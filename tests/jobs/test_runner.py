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

DOMAIN = "route"

WITHIN_S = 120
CONFIG = RemapConfig("drive", "other", n_landmarks=8)


class Gate:
    """Does jobs in this process, each once it is let through."""

    def __init__(self, data_dir):
        self.entered, self.open = threading.Event(), threading.Event()
        self.run_job = InThisProcess(data_dir)

    def __call__(self, job, on_progress, is_cancelled):
        self.entered.set()
        assert self.open.wait(WITHIN_S)
        return self.run_job(job, on_progress, is_cancelled)


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


@pytest.fixture
def drives(drive):
    drive("other", 30, seed=1)
    drive("drive", 12)


def test_a_job_of_one_id_is_made_once_whoever_asks_and_whenever(catalog, drives):
    gate = Gate(catalog.data_dir)
    job_id, job_ids = "a" * 32, []
    runner = JobRunner(catalog, gate, lambda domain: None, max_waiting=1)
    try:
        first = runner.submit(DOMAIN, CONFIG, job_id)
        assert gate.entered.wait(WITHIN_S)
        other = threading.Barrier(8)

        def ask():
            other.wait(WITHIN_S)
            job_ids.append(runner.submit(DOMAIN, CONFIG, "b" * 32).job_id)

        asking = [threading.Thread(target=ask) for _ in range(8)]
        for thread in asking:
            thread.start()
        for thread in asking:
            thread.join(WITHIN_S)
        assert job_ids == ["b" * 32] * 8, "one alone finds room to wait; the others find that one"
        with pytest.raises(IdempotencyKeyReusedError):
            runner.submit(DOMAIN, RemapConfig("drive", "other", n_landmarks=7), job_id)
        gate.open.set()
        ended_job(catalog, "b" * 32)
    finally:
        gate.open.set()
        runner.close()
    assert runner.submit(DOMAIN, CONFIG, job_id).state is JobState.SUCCEEDED, "nothing new is asked of it"
    with running(catalog) as again:
        job = again.submit(DOMAIN, CONFIG, job_id)
        assert (job.job_id, job.created_at, job.result["map_version"]) == (job_id, first.created_at, 1)
        with pytest.raises(IdempotencyKeyReusedError):
            again.submit(DOMAIN, RemapConfig("drive", "other", n_landmarks=7), job_id)
    assert [record.version for record in catalog.maps(DOMAIN)] == [1, 2]


def test_a_job_that_meets_damage_says_in_which_traverse(catalog, drives):
    path = catalog.data_dir / "domains" / DOMAIN / "traverses" / "other.sqlite"
    path.write_bytes(b"no database" * 1000)
    with running(catalog) as runner:
        job = ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id)
    assert (job.state, job.error["code"], job.error["file"]) == (JobState.FAILED, "damaged_file", "other.sqlite")
    assert job.error["message"].startswith("other.sqlite is damaged")


def test_a_running_job_is_cancelled_at_its_next_report_and_leaves_no_map(catalog, drives):
    gate = Gate(catalog.data_dir)
    with running(catalog, gate) as runner:
        job = runner.submit(DOMAIN, CONFIG)
        assert gate.entered.wait(WITHIN_S)
        runner.cancel(job.job_id)
        gate.open.set()
        job = ended_job(catalog, job.job_id)
        assert job.state is JobState.CANCELLED
        assert job.error["code"] == "cancelled"
        assert catalog.maps(DOMAIN) == []
        assert ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id).state is JobState.SUCCEEDED, "it goes on"


def test_a_job_that_breaks_tells_no_inner_detail_and_the_runner_goes_on(catalog, drives, caplog):
    broken = [True]
    sound_run = InThisProcess(catalog.data_dir)

    def run_job(job, on_progress, is_cancelled):
        if broken.pop():
            raise ZeroDivisionError("secret")
        return sound_run(job, on_progress, is_cancelled)

    with running(catalog, run_job) as runner:
        job = ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id)
        broken.append(False)
        assert ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id).state is JobState.SUCCEEDED
    assert job.state is JobState.FAILED
    assert job.error["code"] == "internal_error"
    assert "secret" not in str(job.error)
    assert "secret" in caplog.text, "the log has it"


def test_closing_leaves_what_runs_and_what_waits_to_the_next_service(catalog, drives):
    gate = Gate(catalog.data_dir)
    runner = JobRunner(catalog, gate, lambda domain: None)
    first, second = (runner.submit(DOMAIN, CONFIG) for _ in range(2))
    assert gate.entered.wait(WITHIN_S)
    closing = threading.Thread(target=runner.close)
    closing.start()
    gate.open.set()
    closing.join(WITHIN_S)
    assert not closing.is_alive()
    stopped = catalog.job(first.job_id)
    assert (stopped.state, stopped.n_starts, stopped.stage) == (JobState.QUEUED, 0, None)
    assert catalog.job(second.job_id).state is JobState.QUEUED
    assert catalog.maps(DOMAIN) == []
    with pytest.raises(UnavailableError, match="shutting down"):
        runner.submit(DOMAIN, CONFIG)
    data_dir = catalog.data_dir
    catalog.close()
    with Catalog.open(data_dir) as again:
        assert again.discard_unfinished() == []
        with running(again):
            assert [ended_job(again, job.job_id).result["map_version"] for job in (first, second)] == [1, 2]
        assert again.discard_unfinished() == []


def test_a_job_that_was_cancelled_as_the_service_stops_stays_cancelled(catalog, drives):
    gate = Gate(catalog.data_dir)
    runner = JobRunner(catalog, gate, lambda domain: None)
    job = runner.submit(DOMAIN, CONFIG)
    assert gate.entered.wait(WITHIN_S)
    runner.cancel(job.job_id)
    closing = threading.Thread(target=runner.close)
    closing.start()
    gate.open.set()
    closing.join(WITHIN_S)
    assert catalog.job(job.job_id).state is JobState.CANCELLED


def dying(catalog, is_before):
    """Does a job until its process dies, before or after its last step."""

    def run_job(job, on_progress, is_cancelled):
        if not is_before:
            InThisProcess(catalog.data_dir)(job, on_progress, is_cancelled)
        with Catalog.open(catalog.data_dir) as child:
            version = child.begin_map(DOMAIN, {})
            child.building_path(DOMAIN, version).write_bytes(b"half a map")
        raise JobInterruptedError("the job's process was ended by SIGKILL", signal="SIGKILL")

    return run_job


def test_a_job_whose_process_died_has_failed_and_leaves_no_half_map(catalog, drives):
    with running(catalog, dying(catalog, is_before=True)) as runner:
        job = ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id)
    assert job.state is JobState.FAILED
    assert (job.error["code"], job.error["signal"]) == ("job_interrupted", "SIGKILL")
    assert catalog.maps(DOMAIN) == []
    assert not catalog.building_path(DOMAIN, 1).exists()


def test_a_job_whose_process_died_behind_its_last_step_has_succeeded(catalog, drives):
    activated = []
    with running(catalog, dying(catalog, is_before=False), activated.append) as runner:
        job = ended_job(catalog, runner.submit(DOMAIN, CONFIG).job_id)
    assert (job.state, job.result["map_version"], job.error) == (JobState.SUCCEEDED, 1, None)
    assert activated == [DOMAIN]
