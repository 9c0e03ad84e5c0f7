"""The fleet as an application of Ray Serve: administrators, replicas that have the domains, the front."""

import signal
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


def build(
    settings: Settings,
    n_replicas: int,
    make_run_job: MakeRunJob | None = None,
    n_encoders: int | None = None,
    encoder_gpus: float = 0.0,
    n_administrators: int = 1,
) -> serve.Application:
    """The fleet as `serve.run` takes it; a part whose process ends is started again.

    Args:
        settings: See `Replica`.
        n_replicas: Processes that have domains.
        make_run_job: See `Replica`.
        n_encoders: Processes that have the networks for all; 0: every replica has its own. None: one where it has a
            GPU; on processors it costs more than it saves.
        encoder_gpus: Share of its machine's GPUs that each of these takes, as Ray counts them.
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
    if n_encoders is None:
        n_encoders = int(encoder_gpus > 0)
    if n_encoders:
        actor_options = {**_DEPLOYMENT["ray_actor_options"], "num_gpus": encoder_gpus}
        encoder_options = {**_DEPLOYMENT, "num_replicas": n_encoders, "ray_actor_options": actor_options}
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
    n_replicas = int(arguments.pop("replicas", 4))
    numbers: dict[str, Any] = {
        "n_encoders": arguments.pop("encoders", None),
        "encoder_gpus": float(arguments.pop("encoder_gpus", 0.0)),
        "n_administrators": int(arguments.pop("administrators", 1)),
    }
    return build(trace_settings(**arguments).settings, n_replicas, **numbers)
