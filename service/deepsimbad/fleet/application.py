"""The fleet as an application of Ray Serve: one that administers, replicas that have the domains, the front."""

import signal
from dataclasses import dataclass
from typing import Any

from ray import serve
from ray.serve.handle import DeploymentHandle
from ray.serve.schema import LoggingConfig

from deepsimbad.errors import SettingsError
from deepsimbad.fleet.encoder import Encoder
from deepsimbad.fleet.front import Front
from deepsimbad.fleet.replica import Replica, replica_name
from deepsimbad.jobs.runner import RunJob
from deepsimbad.settings import Settings, trace_settings

NAME = "deepsimbad"
_EACH: dict[str, Any] = {
    "num_replicas": 1,  # of every name
    "max_ongoing_requests": 100_000,  # the door of the application counts
    "health_check_period_s": 1.0,
    "graceful_shutdown_timeout_s": 10.0,
    "graceful_shutdown_wait_loop_s": 0.1,
    "logging_config": LoggingConfig(enable_access_log=False, log_level="WARNING"),
    "ray_actor_options": {"num_cpus": 0.25},
}


@dataclass(frozen=True)
class Encoders:
    """How many processes have the networks for all; with none every replica has its own."""

    asked: int | None = None  # None: one where it has a GPU; on processors it costs more than it spares
    num_gpus: float = 0.0  # that each of them takes of its machine's, as Ray counts them

    @property
    def number(self) -> int:
        """How many there are."""
        return int(self.num_gpus > 0) if self.asked is None else self.asked


def build(
    settings: Settings, n_replicas: int, run_job: RunJob | None = None, encoders: Encoders = Encoders()
) -> serve.Application:
    """What `serve.run` takes; every part is restarted where its process ends."""
    if settings.map_store is None:
        raise SettingsError(
            "a fleet shares maps and sessions in a map store: name one with --map-store, as s3://bucket/prefix or, on "
            "one machine, file:///folder",
            setting="map_store",
        )
    whole = serve.deployment(**_EACH)(Replica)
    encoder = None
    if encoders.number:
        takes = {**_EACH["ray_actor_options"], "num_gpus": encoders.num_gpus}
        of_networks = {**_EACH, "num_replicas": encoders.number, "ray_actor_options": takes}
        encoder = serve.deployment(**of_networks)(Encoder).options(name="encoder").bind(settings)
    admin = whole.options(name="admin").bind(settings, n_replicas, encoder, None, run_job)
    replicas = [
        whole.options(name=replica_name(number)).bind(settings, n_replicas, encoder, admin)
        for number in range(n_replicas)
    ]
    return serve.deployment(**_EACH)(Front).options(name="front").bind(settings, admin, *replicas)


def start(
    settings: Settings,
    n_replicas: int,
    run_job: RunJob | None = None,
    name: str = NAME,
    encoders: Encoders = Encoders(),
) -> DeploymentHandle[Front]:
    """Start the fleet in the cluster that this process has joined; returns when it answers."""
    serve.start(proxy_location="Disabled")  # the front listens itself
    return serve.run(build(settings, n_replicas, run_job, encoders), name=name, route_prefix=None)


def wait() -> None:
    """Until interrupted or told to end, and let every process finish what it has begun."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        signal.pause()
    except KeyboardInterrupt:
        serve.shutdown()


def from_yaml(arguments: dict[str, Any]) -> serve.Application:
    """What `serve deploy serve.yaml` asks for: `replicas`, `encoders`, `encoder_gpus`, any setting by its name."""
    n_replicas = int(arguments.pop("replicas", 4))
    encoders = Encoders(arguments.pop("encoders", None), float(arguments.pop("encoder_gpus", 0.0)))
    return build(trace_settings(**arguments).settings, n_replicas, encoders=encoders)
