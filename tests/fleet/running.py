"""A fleet on this machine: one small cluster of Ray's for a process of tests, in it as many fleets as are wanted."""

import itertools
import os
import signal
import warnings
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from deepsimbad.settings import Settings

with warnings.catch_warnings(action="ignore"):  # which are Ray's, of what it uses
    import ray
    from ray import serve
    from ray.serve.schema import ServeDeploySchema  # noqa: F401 - for tests

    from deepsimbad.fleet import application
    from deepsimbad.fleet.application import from_yaml  # noqa: F401 - for tests

# Processes are found by these names, also those of tests that run beside these in another cluster.
_names = (f"fleet-{os.getpid()}-{number}" for number in itertools.count())


@cache
def cluster():
    """Start the cluster, once; it ends with the process."""
    os.environ.setdefault("RAY_worker_niceness", "0")  # as the command has it
    ray.init(
        num_cpus=100,  # that are counted, not used
        include_dashboard=False,
        object_store_memory=78_643_200,
        log_to_driver=False,
        logging_level="ERROR",
    )


class Fleet:
    """The address of a fleet, and its processes."""

    def __init__(self, name, address):
        self.name = name
        self.url = "http://{}:{}".format(*address)

    def pids(self, deployment):
        """The processes of a deployment now."""
        title = f"ray::ServeReplica:{self.name}:{deployment}".encode()
        pids = []
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                process_title = (process / "cmdline").read_bytes().partition(b"\0")[0]
                if process_title.partition(b".")[0] == title:  # behind a dot stands what it does
                    pids.append(int(process.name))
        return pids

    def kill(self, deployment):
        for pid in self.pids(deployment):
            os.kill(pid, signal.SIGKILL)


@contextmanager
def running(settings: Settings, n_replicas=2, make_run_job=None, n_administrators=1):
    """A fleet that answers within the block, and is deleted after it."""
    name = next(_names)
    store = settings.map_store or f"file://{settings.data_dir}-store"
    settings = settings.model_copy(update={"port": 0, "map_store": store, "log_level": "WARNING"})
    try:
        with warnings.catch_warnings(action="ignore"):
            cluster()
            fleet = application.build(settings, n_replicas, make_run_job, 1, n_administrators=n_administrators)
            front = application.start(fleet, name)
            address = front.address.remote().result()
        yield Fleet(name, address)
    finally:
        with warnings.catch_warnings(action="ignore"):
            serve.delete(name)
