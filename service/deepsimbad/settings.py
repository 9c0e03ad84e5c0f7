"""What an operator may set: one frozen object, read by the command line and the API alone.

Flags go before the environment, the environment before a file, the file before defaults.
"""

import ipaddress
import os
import re
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import (
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    field_validator,
)
from pydantic_settings import BaseSettings, EnvSettingsSource, SettingsConfigDict, TomlConfigSettingsSource
from pydantic_settings import SettingsError as UndecodableError

from deepsimbad.errors import SettingsError
from deepsimbad.evaluators.compute import DEFAULT_WEIGHTS_DIR, Compute, Device, Runtime
from deepsimbad.jobs.child import JobPriority

MEBIBYTE = 1024 * 1024
CONFIG_VARIABLE = "DEEPSIMBAD_CONFIG"
CONFIG_FILE = Path("deepsimbad.toml")
# Of the client and of the tests
_OTHER_VARIABLES = {CONFIG_VARIABLE, "DEEPSIMBAD_URL", "DEEPSIMBAD_API_KEY", "DEEPSIMBAD_REAL_DATA"}
_ORIGIN = re.compile(r"\*|[a-z][a-z0-9+.-]*://[^/\s*?#@]+")


class Settings(BaseSettings):
    """Settings of the service. Each has an environment variable: `DEEPSIMBAD_` and its name in capitals."""

    model_config = SettingsConfigDict(
        env_prefix="DEEPSIMBAD_",
        env_ignore_empty=True,  # a compose file passes on what is not set as an empty text
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    data_dir: Path = Path("deepsimbad-data")
    """Folder of the catalog, traverses and maps."""
    map_store: Annotated[str | None, Field(min_length=1)] = None
    """URL of the objects by which machines share maps, as `s3://bucket/prefix`; none: what the data directory had."""
    map_cache_disk_bytes: PositiveInt = 16384 * MEBIBYTE
    """Map files kept that a map store has too, in bytes; those asked for longest ago are removed, unless in use."""
    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """Port to listen on; 0 takes a free one."""
    root_path: Annotated[str, Field(pattern=r"^(/[A-Za-z0-9._~-]+)*$")] = ""
    """Path below which a proxy shows the service, as `/simbad`: `Location` and `/docs` heed it."""
    allow_open: bool = False
    """Serve without keys on an address other machines can reach. Off: refuse to start."""
    require_keys: bool = False
    """Refuse to start before a key was created, on a loopback address too."""
    log_level: Annotated[str, Field(pattern="^(DEBUG|INFO|WARNING|ERROR)$")] = "INFO"
    """Least level that is logged."""

    max_image_bytes: PositiveInt = 32 * MEBIBYTE
    """Largest image body, in bytes."""
    max_json_bytes: PositiveInt = 4 * MEBIBYTE
    """Largest JSON body, in bytes."""
    max_batch_bytes: PositiveInt = 1024 * MEBIBYTE
    """Largest batch of frames, in bytes: as sent, and again unpacked."""
    max_spool_bytes: PositiveInt = 4096 * MEBIBYTE
    """Images of one domain that may wait for its evaluator to be fitted, in bytes; with more, frames are refused."""
    max_pixels: PositiveInt = 50_000_000
    """Most pixels an image's header may claim (width times height)."""

    max_header_bytes: Annotated[int, Field(ge=1024)] = 64 * 1024
    """Most bytes of a request's headers."""
    max_body_memory_bytes: PositiveInt = 512 * MEBIBYTE
    """Bodies held in memory at once, all requests together, in bytes."""
    max_requests: PositiveInt = 256
    """Requests under way at once; more are answered 503."""
    max_queue: PositiveInt = 128
    """Views waiting for the inference worker; more are answered 503."""
    max_uploads: PositiveInt = 4
    """Batches of frames on their way at once."""
    max_event_streams: PositiveInt = 64
    """Job event streams open at once."""
    max_connections: PositiveInt = 1024
    """Connections, or requests, open at once; with one more all are answered 503."""
    max_domains: PositiveInt = 100_000
    """Domains that may exist."""
    map_cache_bytes: PositiveInt = 1024 * MEBIBYTE
    """Active maps held in memory, in bytes of their arrays; those asked longest ago give way, and are read again."""
    rate_limit_per_s: NonNegativeFloat = 200.0
    """Requests a second that one key may send, in the long run; 0: any number."""
    rate_limit_burst: PositiveInt = 400
    """Requests that one key may send at once before its rate counts."""
    cors_origins: tuple[str, ...] = ()
    """Origins whose pages may call the service (CORS), a JSON list; empty: none."""
    tls_certificate: Path | None = None
    """PEM file to serve HTTPS with, its key in it or in `tls_key`; none: HTTP."""
    tls_key: Path | None = None
    """PEM file of the certificate's key."""

    keep_alive_s: PositiveInt = 75
    """An idle connection is closed after this."""
    shutdown_grace_s: NonNegativeInt = 10
    """Requests under way at shutdown get this long to finish."""
    event_poll_s: Annotated[float, Field(gt=0, le=10)] = 0.25
    """A job's event stream looks for news this often."""

    keep_maps: PositiveInt = 5
    """Retired map versions kept a domain, to roll back to; older files are removed."""
    max_jobs: PositiveInt = 100
    """Jobs that may wait their turn; one more is answered 429."""
    job_threads: NonNegativeInt = 0
    """Threads that a job computes in; 0: one less than there are cores."""
    job_priority: JobPriority = JobPriority.IDLE
    """`idle`: jobs run when nothing else on the machine would; `low`, `normal`: beside it."""

    weights_dir: Annotated[Path, Field(validate_default=True)] = DEFAULT_WEIGHTS_DIR
    """Folder of networks' weights, and of what is prepared from them."""
    network_runtime: Runtime = Runtime.AUTO
    """What runs networks: `torch`, `torch_bf16`, `onnxruntime`; `auto`: the fastest that is there."""
    network_device: Device = Device.AUTO
    """Where: `cpu`, `cuda`; `auto`: CUDA where there is one that works."""
    network_threads: NonNegativeInt = 0
    """Processor threads of a network; 0: as many as there are cores."""
    encode_batch: Annotated[int, Field(ge=0, le=1024)] = 0
    """Most images encoded at once; 0: what measures best, on CUDA 32, else 1 to four a core."""
    encode_wait_ms: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """How long an image waits for others to fill a batch; 0: for none."""

    session_ttl_s: Annotated[float, Field(gt=0, le=31536000)] = 3600.0
    """A session ends when nothing was observed in it for so long."""
    max_sessions: PositiveInt = 1000
    """Sessions that may live at once."""
    max_sessions_per_key: PositiveInt = 100
    """Sessions of one API key that may live at once."""
    snapshot_every: PositiveInt = 32
    """Observations of a session between two snapshots of its belief."""
    keep_ended_sessions_s: NonNegativeFloat = 86_400.0
    """What a session saw is kept for so long after its end, for its truths."""
    session_sweep_s: PositiveFloat = 30.0
    """Expired sessions are looked for this often."""

    @field_validator("weights_dir")
    @classmethod
    def _at_home(cls, folder: Path) -> Path:
        return folder.expanduser()

    @field_validator("cors_origins")
    @classmethod
    def _origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            if _ORIGIN.fullmatch(origin) is None:  # any other text would silently match nobody
                raise ValueError(f'{origin!r} is no origin: write it as "https://host" or "https://host:port", or "*"')
        return origins

    def compute(self) -> Compute:
        """How networks are computed."""
        return Compute(
            self.network_runtime, self.network_device, self.network_threads, self.encode_batch, self.weights_dir
        )

    def check_exposure(self, n_keys: int) -> None:
        """Refuse to be reachable from other machines while the service asks for no key; raises SettingsError.

        Args:
            n_keys: Keys that were ever created, revoked ones too.
        """
        if n_keys == 0 and self.require_keys:
            raise SettingsError(
                "refusing to serve without keys, because require_keys is set: make one with `deepsimbad keys create "
                "--scope admin`; if there were keys, this is not their data directory",
                setting="require_keys",
            )
        if n_keys == 0 and not is_loopback(self.host) and not self.allow_open:
            raise SettingsError(
                f"refusing to serve without keys on {self.host}, which other machines can reach: make a key with "
                "`deepsimbad keys create --scope admin`, listen on 127.0.0.1, or set DEEPSIMBAD_ALLOW_OPEN=true if "
                "the network is trusted",
                host=self.host,
            )


def is_loopback(host: str) -> bool:
    """Whether a name or an address means this machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class TracedSettings(NamedTuple):
    """Settings, what decided each (flag, environment, file or default), and the settings file that was read, if any."""

    settings: Settings
    origins: Mapping[str, str]
    file: Path | None


def trace_settings(config: Path | None = None, **flags: object) -> TracedSettings:
    """Settings from the flags, the environment, the settings file and the defaults, in this order.

    Args:
        config: The settings file; None: the one that $DEEPSIMBAD_CONFIG names, else ./deepsimbad.toml if it is there.
        **flags: Settings by name; those that are None count as not given.

    Raises:
        SettingsError: The file cannot be read, a name is unknown or a value cannot be used.
    """
    file = _settings_file(config)
    places = {
        "flag": "the command line",
        "environment": "the environment",
        "file": str(file),
        "default": "the defaults",
    }

    def unusable(name: str, origin: str, reason: str) -> SettingsError:
        variable = f" ({variable_of(name)})" if origin == "environment" else ""
        return SettingsError(f"setting {name!r} of {places[origin]}{variable} cannot be used: {reason}", setting=name)

    try:
        environment = EnvSettingsSource(Settings)()
    except UndecodableError as error:
        name = next((name for name in Settings.model_fields if f'"{name}"' in str(error)), "?")
        raise unusable(name, "environment", "not a JSON list") from error
    sources: dict[str, dict[str, Any]] = {  # strongest first
        "flag": {name: value for name, value in flags.items() if value is not None},
        "environment": environment,
        "file": {} if file is None else _read(file),
        "default": {name: field.default for name, field in Settings.model_fields.items()},
    }
    for origin, values in sources.items():
        for name in sorted(values.keys() - Settings.model_fields):
            matches = get_close_matches(name.lower(), Settings.model_fields, 1)
            hint = f": did you mean {matches[0]!r}?" if matches else "; `deepsimbad settings` lists those there are"
            raise SettingsError(f"there is no setting {name!r}, which stands in {places[origin]}{hint}", setting=name)
    origins = {name: next(origin for origin in sources if name in sources[origin]) for name in Settings.model_fields}
    try:
        settings = Settings(**{name: sources[origin][name] for name, origin in origins.items() if origin != "default"})
    except ValidationError as error:
        finding = error.errors(include_url=False, include_input=False)[0]
        name = str(finding["loc"][0]) if finding["loc"] else "?"
        raise unusable(name, origins.get(name, "default"), finding["msg"]) from error
    return TracedSettings(settings, origins, file)


def unknown_variables() -> list[str]:
    """The variables of the environment that look like settings and are none: perhaps mistyped."""
    variables = {variable_of(name) for name in Settings.model_fields} | _OTHER_VARIABLES
    return sorted(name for name in os.environ if name.startswith("DEEPSIMBAD_") and name not in variables)


def variable_of(name: str) -> str:
    """The environment variable of a setting."""
    return f"DEEPSIMBAD_{name.upper()}"


def _settings_file(config: Path | None) -> Path | None:
    """The file to read; a file that was asked for must be there, the one of the working folder need not."""
    asked_by = "--config"
    if config is None and os.environ.get(CONFIG_VARIABLE):
        config, asked_by = Path(os.environ[CONFIG_VARIABLE]), CONFIG_VARIABLE
    if config is None:
        return CONFIG_FILE if CONFIG_FILE.exists() else None
    if not config.exists():
        raise SettingsError(f"there is no settings file {config}, which {asked_by} names", file=str(config))
    return config


def _read(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise SettingsError(f"{file} is no settings file", file=str(file))
    try:
        return TomlConfigSettingsSource(Settings, toml_file=file)()
    except OSError as error:
        raise SettingsError(f"settings file {file} cannot be read: {error.strerror}", file=str(file)) from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"settings file {file} is not TOML: {error}", file=str(file)) from error
