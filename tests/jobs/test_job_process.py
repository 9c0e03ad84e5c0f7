"""Jobs in a process of their own: the same results and errors, out of everybody's way, and never an orphan."""

import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.errors import (
    CancelledError,
    DeepSimbadError,
    JobInterruptedError,
    TooFewCandidatesError,
    UnavailableError,
)
from deepsimbad.evaluators.compute import Compute
from deepsimbad.jobs import child, runner
from deepsimbad.jobs.child import JobPriority
from deepsimbad.jobs.remap_config import RemapConfig
from deepsimbad.jobs.runner import REMAP, BrokenJobError, InAnotherProcess, InThisProcess
from deepsimbad.store.durable import lock_folder

from .conftest import DOMAIN

WITHIN_S = 600
CONFIG = RemapConfig("drive", "other", n_landmarks=8, training_episodes=200)
COMMAND = [sys.executable, "-P", "-m", "deepsimbad.jobs.child", "normal"]
# On a busy machine a job of the default priority hardly gets on.
in_another_process = partial(InAnotherProcess, priority=JobPriority.NORMAL)


def never():
    return False


def ignore(state):
    return None


@pytest.fixture
def job(catalog, drive):
    drive("other", 60, seed=1)
    drive("drive", 60)
    return catalog.start_job(catalog.create_job(DOMAIN, REMAP, CONFIG.as_dict()).job_id)


def test_the_map_is_the_one_that_this_process_would_make(catalog, contents, job, caplog):
    states = []
    with caplog.at_level(logging.INFO, "deepsimbad"):
        result = in_another_process(catalog.data_dir, 1)(job, states.append, never)
    assert (result["map_version"], result["metrics"]) == (1, catalog.map(DOMAIN, 1).metrics)
    assert (states[0].stage, states[-1].stage) == ("read frames", "activate")
    other = catalog.start_job(catalog.create_job(DOMAIN, REMAP, CONFIG.as_dict()).job_id)
    InThisProcess(catalog.data_dir)(other, ignore, never)
    np.testing.assert_equal(*(asdict(replace(contents(v), version=0, created_at="")) for v in (1, 2)))


def test_errors_come_back_by_name_with_what_helps(catalog, job):
    failing = replace(job, config={**job.config, "n_landmarks": 61})
    with pytest.raises(TooFewCandidatesError, match="60 candidates for 61") as raised:
        in_another_process(catalog.data_dir, 1)(failing, ignore, never)
    assert raised.value.hints == {"n_candidates": 60, "n_landmarks": 61}


def test_what_breaks_has_its_stack_in_the_notes_alone(catalog, job):
    with pytest.raises(BrokenJobError) as raised:
        in_another_process(catalog.data_dir, 1)(replace(job, config={"levitate": True}), ignore, never)
    assert "levitate" not in str(raised.value)
    assert "Traceback" in raised.value.__notes__[0]


def test_its_log_lines_are_the_services_with_the_jobs_id(monkeypatch, caplog):
    messages = []
    monkeypatch.setattr(child, "_tell", lambda **message: messages.append(json.loads(json.dumps(message))))
    attributes = {"name": "deepsimbad.store", "levelno": logging.WARNING, "msg": "%s rots", "args": ("it",)}
    child._LogToParent().emit(logging.makeLogRecord({**attributes, "file": "f"}))
    runner._log_here(messages[0]["log"], "j")
    record = caplog.records[-1]
    assert (record.name, record.levelname, record.getMessage()) == ("deepsimbad.store", "WARNING", "it rots")
    assert (record.__dict__["job_id"], record.__dict__["file"]) == ("j", "f")


def proc_file(pid, name):
    return Path("/proc", str(pid), name)


class Doing:
    """A job in a child that cannot begin its map."""

    def __init__(self, job, caplog, run_job):
        self.cancelled, self.ending = threading.Event(), None
        self._run_job, self._caplog = run_job, caplog
        self._thread = threading.Thread(target=self._run, args=[job])
        self._thread.start()
        self.pid = self._wait_for(self._pid)

    def _run(self, job):
        try:
            self.ending = self._run_job(job, ignore, self.cancelled.is_set)
        except DeepSimbadError as error:
            self.ending = error

    def _pid(self):
        return next((record.__dict__["pid"] for record in self._caplog.records if "pid" in record.__dict__), None)

    def _wait_for(self, answer):
        give_up = time.monotonic() + WITHIN_S
        while not (value := answer()):
            assert time.monotonic() < give_up
            time.sleep(0.01)
        return value

    def until_ready(self):
        """Until it yields to everyone and listens: its listening thread is there."""
        self._wait_for(lambda: len(list(proc_file(self.pid, "task").iterdir())) > 1)

    def end(self):
        self._thread.join(WITHIN_S)
        assert not self._thread.is_alive()
        return self.ending


@contextmanager
def no_map_begins(catalog):
    descriptor = lock_folder(catalog.map_path(DOMAIN, 1).parent, fcntl.LOCK_EX)
    try:
        yield
    finally:
        os.close(descriptor)


@contextmanager
def running(catalog, job, caplog, run_job):
    with caplog.at_level(logging.INFO, "deepsimbad"):
        with no_map_begins(catalog):
            doing = Doing(job, caplog, run_job)
            try:
                yield doing
            finally:
                doing.cancelled.set()
        doing.end()


SCHEDULERS = {"idle": "SCHED_IDLE", "low": "SCHED_BATCH", "normal": "SCHED_OTHER"}


@pytest.mark.skipif(sys.platform != "linux", reason="the scheduling classes are Linux's")
@pytest.mark.parametrize(
    ("priority", "signal_number", "message"),
    [
        ("idle", signal.SIGKILL, "where memory runs out"),
        ("low", signal.SIGSEGV, "ended by SIGSEGV"),
        ("normal", signal.SIGABRT, "ended by SIGABRT"),
    ],
)
def test_it_yields_as_far_and_computes_in_the_threads_it_is_told_and_its_death_names_its_signal(
    catalog, job, caplog, priority, signal_number, message
):
    nice = os.getpriority(os.PRIO_PROCESS, 0) if priority == "normal" else 19
    with running(catalog, job, caplog, InAnotherProcess(catalog.data_dir, 3, JobPriority(priority))) as doing:
        doing.until_ready()
        for task in proc_file(doing.pid, "task").iterdir():
            assert os.sched_getscheduler(int(task.name)) == getattr(os, SCHEDULERS[priority]), "every thread of it"
            assert os.getpriority(os.PRIO_PROCESS, int(task.name)) == nice
        assert int(proc_file(doing.pid, "oom_score_adj").read_text(encoding="ascii")) >= 500
        environment = proc_file(doing.pid, "environ").read_text(encoding="utf-8").split("\0")
        for library in ("NUMBA", "OMP", "OPENBLAS"):
            assert f"{library}_NUM_THREADS=3" in environment
        os.kill(doing.pid, signal_number)
        error = doing.end()
    assert isinstance(error, JobInterruptedError)
    assert message in error.message
    assert error.hints == {"signal": signal_number.name}
    words = [record.__dict__["line"] for record in caplog.records if record.getMessage() == "the job's process said"]
    assert any("Fatal Python error" in line for line in words) == (signal_number != signal.SIGKILL)


def test_a_cancel_is_heard(catalog, job, caplog):
    with running(catalog, job, caplog, in_another_process(catalog.data_dir, 3, stops_within_s=WITHIN_S)) as doing:
        doing.cancelled.set()
        error = doing.end()
    assert isinstance(error, CancelledError)
    assert "killed" not in error.message
    assert catalog.maps(DOMAIN) == []


def test_what_stops_the_service_does_not_stop_its_job_first(catalog, job, caplog):
    with running(catalog, job, caplog, in_another_process(catalog.data_dir, 3)) as doing:
        doing.until_ready()
        for signal_number in (signal.SIGINT, signal.SIGTERM):
            os.kill(doing.pid, signal_number)
        time.sleep(0.2)
        os.kill(doing.pid, 0)
        assert doing.ending is None
        assert os.getpgid(doing.pid) != os.getpgid(0), "Ctrl-C is for the service alone"
        assert os.getsid(doing.pid) == os.getsid(0), "Linux weighs sessions against each other, whatever their classes"


def test_a_cancel_is_enforced(catalog, job, caplog):
    with running(catalog, job, caplog, in_another_process(catalog.data_dir, 1, stops_within_s=0.2)) as doing:
        os.kill(doing.pid, signal.SIGSTOP)
        doing.cancelled.set()
        error = doing.end()
    assert isinstance(error, CancelledError)
    assert "killed" in error.message


def test_a_cancel_that_comes_too_late_leaves_the_result(catalog, job, monkeypatch):
    script = """print('words\\n{"result": {"map_version": 1}}')"""
    process = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    monkeypatch.setattr(InAnotherProcess, "_start", lambda *_: process)

    def ends_first():
        return process.wait() == 0

    assert in_another_process(catalog.data_dir, 1)(job, ignore, ends_first) == {"map_version": 1}


def test_without_its_parent_it_ends(catalog, job):
    order = {"job": asdict(job), "data_dir": str(catalog.data_dir), "n_threads": 1, "log_level": logging.INFO}
    order |= {"parent_pid": os.getpid(), "compute": asdict(Compute())}
    with no_map_begins(catalog):
        for changed, closes in (({}, True), ({"parent_pid": 1}, False)):
            with subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as child:
                assert child.stdin is not None
                child.stdin.write(json.dumps(order | changed, default=str).encode() + b"\n")
                child.stdin.flush()
                if closes:
                    child.stdin.close()
                assert child.wait(WITHIN_S) == 3
    unsaid = subprocess.run(COMMAND, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, check=False, timeout=WITHIN_S)
    assert (unsaid.returncode, unsaid.stdout) == (3, b"")


SERVICE = """
import logging, sys
from pathlib import Path
from deepsimbad.jobs.child import JobPriority
from deepsimbad.jobs.runner import InAnotherProcess
from deepsimbad.store.catalog import Catalog
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(pid)s")
data_dir = Path(sys.argv[1])
with Catalog.open(data_dir) as catalog:
    job = catalog.job(sys.argv[2])
    InAnotherProcess(data_dir, 1, JobPriority.NORMAL)(job, lambda state: None, lambda: False)
"""


def test_killed_together_with_its_parent(catalog, job):
    with no_map_begins(catalog):
        command = [sys.executable, "-c", SERVICE, str(catalog.data_dir), job.job_id]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
            assert service.stdout is not None
            pid = int(service.stdout.readline())
            service.kill()
        give_up = time.monotonic() + WITHIN_S
        while is_running(pid):
            assert time.monotonic() < give_up
            time.sleep(0.01)


def is_running(pid):
    try:
        return proc_file(pid, "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_where_no_process_can_be_started_the_job_fails_by_name(catalog, job, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(catalog.data_dir / "nothing"))
    with pytest.raises(UnavailableError, match="no process could be started"):
        in_another_process(catalog.data_dir, 1)(job, ignore, never)
