"""What an operator may set: one frozen object, read by the command line and the API alone."""

import ipaddress
import re
from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from deepsimbad.errors import SettingsError
from deepsimbad.evaluators.compute import DEFAULT_WEIGHTS_DIR, Compute, Device, Runtime
from deepsimbad.jobs.child import JobPriority

MEBIBYTE = 1024 * 1024
_ORIGIN = re.compile(r"\*|[a-z][a-z0-9+.-]*://[^/\s*?#@]+")


class Settings(BaseSettings):
    """Settings of the service. Each has an environment variable: `DEEPSIMBAD_` and its name in capitals.

    Arguments given to the constructor go before the environment, the environment before the defaults;
    `settings_sources.load_settings` reads a settings file as well.
    """

    model_config = SettingsConfigDict(
        env_prefix="DEEPSIMBAD_",
        env_ignore_empty=True,  # a compose file passes on what is not set as an empty text
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
    )

    data_dir: Annotated[Path, Field(description="Folder of the catalog, traverses and maps.")] = Path("deepsimbad-data")
    host: Annotated[str, Field(description="Address to listen on.", min_length=1)] = "127.0.0.1"
    port: Annotated[int, Field(description="Port to listen on; 0 takes a free one.", ge=0, le=65535)] = 8000
    allow_open: Annotated[
        bool,
        Field(description="Serve without keys on an address other machines can reach. Off: refuse to start."),
    ] = False
    log_level: Annotated[
        str, Field(description="Least level that is logged.", pattern="^(DEBUG|INFO|WARNING|ERROR)$")
    ] = "INFO"

    max_image_bytes: Annotated[int, Field(description="Largest image body, in bytes.", ge=1)] = 32 * MEBIBYTE
    max_json_bytes: Annotated[int, Field(description="Largest JSON body, in bytes.", ge=1)] = 4 * MEBIBYTE
    max_batch_bytes: Annotated[
        int, Field(description="Largest batch of frames, in bytes: as sent, and again unpacked.", ge=1)
    ] = 1024 * MEBIBYTE
    max_pixels: Annotated[
        int, Field(description="Most pixels an image's header may claim (width times height).", ge=1)
    ] = 50_000_000

    max_header_bytes: Annotated[int, Field(description="Most bytes of a request's headers.", ge=1024)] = 64 * 1024
    max_body_memory_bytes: Annotated[
        int, Field(description="Bodies held in memory at once, all requests together, in bytes.", ge=1)
    ] = 512 * MEBIBYTE
    max_requests: Annotated[int, Field(description="Requests under way at once; more are answered 503.", ge=1)] = 256
    max_queue: Annotated[
        int, Field(description="Views waiting for the inference worker; more are answered 503.", ge=1)
    ] = 128
    max_uploads: Annotated[int, Field(description="Batches of frames on their way at once.", ge=1)] = 4
    max_event_streams: Annotated[int, Field(description="Job event streams open at once.", ge=1)] = 64
    max_connections: Annotated[
        int, Field(description="Connections open at once; for one more the longest silent is closed.", ge=1)
    ] = 1024
    max_domains: Annotated[int, Field(description="Domains that may exist.", ge=1)] = 1000
    rate_limit_per_s: Annotated[
        float, Field(description="Requests a second that one key may send, in the long run; 0: any number.", ge=0)
    ] = 200.0
    rate_limit_burst: Annotated[
        int, Field(description="Requests that one key may send at once before its rate counts.", ge=1)
    ] = 400
    cors_origins: Annotated[
        tuple[str, ...], Field(description="Origins whose pages may call the service (CORS), a JSON list; empty: none.")
    ] = ()
    tls_certificate: Annotated[Path | None, Field(description="PEM file to serve HTTPS with; none: HTTP.")] = None
    tls_key: Annotated[Path | None, Field(description="PEM file of the certificate's key.")] = None

    header_timeout_s: Annotated[
        float, Field(description="A connection is closed where a request's headers take longer.", gt=0)
    ] = 10.0
    stall_timeout_s: Annotated[
        float,
        Field(
            description="A connection is closed where a body's, or an answer's, bytes stop moving for so long.", gt=0
        ),
    ] = 30.0
    keep_alive_s: Annotated[int, Field(description="An idle connection is closed after this.", ge=1)] = 75
    shutdown_grace_s: Annotated[
        int, Field(description="Requests under way at shutdown get this long to finish.", ge=0)
    ] = 10
    event_poll_s: Annotated[
        float, Field(description="A job's event stream looks for news this often.", gt=0, le=10)
    ] = 0.25

    keep_maps: Annotated[
        int, Field(description="Retired map versions kept a domain, to roll back to; older files are removed.", ge=1)
    ] = 5
    max_jobs: Annotated[int, Field(description="Jobs that may wait their turn; one more is answered 429.", ge=1)] = 100
    job_threads: Annotated[
        int, Field(description="Threads that a job computes in; 0: one less than there are cores.", ge=0)
    ] = 0
    job_priority: Annotated[
        JobPriority,
        Field(description="`idle`: jobs run when nothing else on the machine would; `low`, `normal`: beside it."),
    ] = JobPriority.IDLE

    weights_dir: Annotated[
        Path,
        Field(description="Folder of networks' weights, and of what is prepared from them.", validate_default=True),
    ] = DEFAULT_WEIGHTS_DIR
    network_runtime: Annotated[
        Runtime,
        Field(
            description="What runs networks: `torch`, `torch_bf16`, `onnxruntime`; `auto`: the fastest that is there."
        ),
    ] = Runtime.AUTO
    network_device: Annotated[
        Device, Field(description="Where: `cpu`, `cuda`; `auto`: CUDA where there is one that works.")
    ] = Device.AUTO
    network_threads: Annotated[
        int, Field(description="Processor threads of a network; 0: as many as there are cores.", ge=0)
    ] = 0
    encode_batch: Annotated[
        int,
        Field(
            description="Most images encoded at once; 0: what measures best, on CUDA 32, else 1 to four a core.",
            ge=0,
            le=1024,
        ),
    ] = 0
    encode_wait_ms: Annotated[
        float, Field(description="How long an image waits for others to fill a batch; 0: for none.", ge=0, le=1000)
    ] = 0.0

    session_ttl_s: Annotated[
        float, Field(description="A session ends when nothing was observed in it for so long.", gt=0, le=31_536_000)
    ] = 3600.0
    max_sessions: Annotated[int, Field(description="Sessions that may live at once.", ge=1)] = 1000
    snapshot_every: Annotated[
        int, Field(description="Observations of a session between two snapshots of its belief.", ge=1)
    ] = 32
    keep_ended_sessions_s: Annotated[
        float, Field(description="What a session saw is kept for so long after its end, for its truths.", ge=0)
    ] = 86_400.0
    session_sweep_s: Annotated[float, Field(description="Expired sessions are looked for this often.", gt=0)] = 30.0

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

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def check_exposure(self, n_keys: int) -> None:
        """Refuse to be reachable from other machines while the service asks for no key.

        Args:
            n_keys: Keys that were ever created, revoked ones too.

        Raises:
            SettingsError: There is none, `host` is not a loopback address and `allow_open` is off.
        """
        if n_keys == 0 and not self.is_loopback and not self.allow_open:
            raise SettingsError(
                f"refusing to serve without keys on {self.host}, which other machines can reach: make a key with "
                "`deepsimbad keys create --scope admin`, listen on 127.0.0.1, or set DEEPSIMBAD_ALLOW_OPEN=true if "
                "the network is trusted",
                host=self.host,
            )
