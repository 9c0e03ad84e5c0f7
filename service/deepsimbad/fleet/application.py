"""The fleet as an application of Ray Serve: administrators, replicas that have the domains, the front."""

import signal
from dataclasses import dataclass
from typing import Any

from ray import serve
from ray.serve.handle import DeploymentHandle
from ray.serve.schema import LoggingConfig

from deepsimbad.errors import SettingsError
from deepsimbad.fleet.encoder import Encoder
from deepsimbad.fleet.front import Front
from deepsimbad.fleet.replica import MakeRunJob, Replica, administrator_name, replica_name
from deepsimbad.settings import Settings, trace_settings

NAME = "deepsimbad"
_DEPLOYMENT: dict[str, Any] = {
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

    requested: int | None = None  # None: one where it has a GPU; on processors it costs more than it saves
    num_gpus: float = 0.0  # share of its machine's GPUs that each of them takes, as Ray counts them

    @property
    def number(self) -> int:
        """How many there are."""
        return int(self.num_gpus > 0) if self.requested is None else self.requested


def build(
    settings: Settings,
    n_replicas: int,
    make_run_job: MakeRunJob | None = None,
    encoders: Encoders = Encoders(),
    n_administrators: int = 1,
) -> serve.Application:
    """The fleet as `serve.run` takes it; a part whose process ends is started again.

    Args:
        settings: See `Replica`.
        n_replicas: Processes that have domains.
        make_run_job: See `Replica`.
        encoders: Processes that have networks.
        n_administrators: Processes that administer, each some of the domains.
    """
    if settings.map_store is None:
        raise SettingsError(
            "a fleet shares maps and sessions in a map store: name one with --map-store, as s3://bucket/prefix or, on "
            "one machine, file:///folder",
            setting="map_store",
        )
    replica = serve.deployment(**_DEPLOYMENT)(Replica)
    encoder = None
    if encoders.number:
        actor_options = {**_DEPLOYMENT["ray_actor_options"], "num_gpus": encoders.num_gpus}
        encoder_options = {**_DEPLOYMENT, "num_replicas": encoders.number, "ray_actor_options": actor_options}
        encoder = serve.deployment(**encoder_options)(Encoder).options(name="encoder").bind(settings)
    arguments = settings, n_replicas, n_administrators, encoder
    admin = replica.options(name=administrator_name(0)).bind(*arguments, None, 0, make_run_job)
    other_admins = [
        replica.options(name=administrator_name(number)).bind(*arguments, admin, number, make_run_job)
        for number in range(1, n_administrators)
    ]
    replicas = [replica.options(name=replica_name(number)).bind(*arguments, admin) for number in range(n_replicas)]
    return serve.deployment(**_DEPLOYMENT)(Front).options(name="front").bind(settings, [admin, *other_admins], replicas)


def start(fleet: serve.Application, name: str = NAME) -> DeploymentHandle[Front]:
    """Start a fleet that `build` made in the cluster that this process has joined; returns when it answers."""
    serve.start(proxy_location="Disabled")  # the front listens itself
    return serve.run(fleet, name=name, route_prefix=None)


def wait() -> None:
    """Wait until interrupted or terminated, then let every process finish what it has begun."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        signal.pause()
    except KeyboardInterrupt:
        serve.shutdown()


def from_yaml(arguments: dict[str, Any]) -> serve.Application:
    """The fleet for `serve deploy serve.yaml`, from options of `deepsimbad ray serve` and any setting by its name."""
    n_replicas, n_administrators = int(arguments.pop("replicas", 4)), int(arguments.pop("administrators", 1))
    encoders = Encoders(arguments.pop("encoders", None), float(arguments.pop("encoder_gpus", 0.0)))
    settings = trace_settings(**arguments).settings
    return build(settings, n_replicas, encoders=encoders, n_administrators=n_administrators)
