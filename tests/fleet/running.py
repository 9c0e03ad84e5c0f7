"""A fleet on this machine: one small cluster of Ray's for a process of tests, in it as many fleets as are wanted."""

import itertools
import os
import signal
import warnings
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from deepsimbad.settings import Settings
from tests.contract.conftest import wait_until

with warnings.catch_warnings(action="ignore"):  # which are Ray's, of what it uses
    import ray
    from ray import serve
    from ray.exceptions import RayError
    from ray.serve.exceptions import RayServeException
    from ray.serve.schema import ServeDeploySchema  # noqa: F401 - for tests

    from deepsimbad.fleet import application
    from deepsimbad.fleet.application import from_yaml  # noqa: F401 - for tests
    from deepsimbad.fleet.replica import replica_name

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

    def __init__(self, name, address, n_replicas):
        self.name = name
        self.replicas = [serve.get_deployment_handle(replica_name(number), name) for number in range(n_replicas)]
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

    def wait_for_replicas(self):
        """Return when all that have domains are back from earlier kills."""
        wait_until(lambda: all(serves(replica) for replica in self.replicas))

    def kill(self, deployment):
        """Kill the process of a deployment: one dies at a time."""
        self.wait_for_replicas()
        for pid in self.pids(deployment):
            os.kill(pid, signal.SIGKILL)


def serves(replica):
    """Whether a replica answers: True once there is one; False: it was killed this moment."""
    try:
        replica.lives.remote(0).result()
    except (RayError, RayServeException):
        return False
    return True


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
        yield Fleet(name, address, n_replicas)
    finally:
        with warnings.catch_warnings(action="ignore"):
            serve.delete(name)
