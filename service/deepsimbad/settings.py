"""What an operator may set: one frozen object, read by the command line and the API alone."""

import ipaddress
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from deepsimbad.errors import SettingsError

MEBIBYTE = 1024 * 1024


class Settings(BaseSettings):
    """Settings of the service. Each has an environment variable: `DEEPSIMBAD_` and its name in capitals.

    Arguments given to the constructor go before the environment, the environment before the defaults.
    """

    model_config = SettingsConfigDict(env_prefix="DEEPSIMBAD_", frozen=True, extra="forbid")

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

    keep_alive_s: Annotated[int, Field(description="An idle connection is closed after this.", ge=1)] = 75
    shutdown_grace_s: Annotated[
        int, Field(description="Requests under way at shutdown get this long to finish.", ge=0)
    ] = 10
    event_poll_s: Annotated[
        float, Field(description="A job's event stream looks for news this often.", gt=0, le=10)
    ] = 0.25

    session_ttl_s: Annotated[
        float, Field(description="A session ends when nothing was observed in it for so long.", gt=0, le=31_536_000)
    ] = 3600.0
    max_sessions: Annotated[int, Field(description="Sessions that may live at once.", ge=1)] = 1000
    snapshot_every: Annotated[
        int, Field(description="Observations of a session between two snapshots of its belief.", ge=1)
    ] = 32
    session_sweep_s: Annotated[float, Field(description="Expired sessions are looked for this often.", gt=0)] = 30.0

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def check_exposure(self) -> None:
        """Refuse to be reachable from other machines while the service has no keys.

        Raises:
            SettingsError: `host` is not a loopback address and `allow_open` is off.
        """
        if not self.is_loopback and not self.allow_open:
            raise SettingsError(
                f"refusing to serve without keys on {self.host}, which other machines can reach: "
                "listen on 127.0.0.1, or set DEEPSIMBAD_ALLOW_OPEN=true if the network is trusted",
                host=self.host,
            )


def load_settings(**given: object) -> Settings:
    """Settings from the arguments given, the environment and the defaults, in this order.

    Args:
        **given: Settings by name; those that are None count as not given.

    Returns:
        The settings.

    Raises:
        SettingsError: A name is unknown or a value cannot be used.
    """
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"setting {name!r} cannot be used: {first['msg']}", setting=name) from error
