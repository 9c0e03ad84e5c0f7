"""HTTPS: the certificate and key that the settings name, and an end to handshakes that nobody finishes."""

import asyncio
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

from deepsimbad.errors import SettingsError

try:
    from uvloop import Loop as _Loop
except ImportError:  # where it cannot be installed
    from asyncio import SelectorEventLoop as _Loop  # type: ignore[assignment]


_SHUTDOWN_TIMEOUT_S = 3600.0  # the protocol itself cuts who does not move; who does gets the end of a long answer


def tls_context(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """What to serve HTTPS with.

    Args:
        certificate: PEM file of the certificate, and those it was signed by.
        key: PEM file of its key, without a passphrase.

    Returns:
        The context; None where neither is given, for HTTP.

    Raises:
        SettingsError: One is missing, cannot be read, or they do not belong together.
    """
    if certificate is None and key is None:
        return None
    if certificate is None or key is None:
        missing = "tls_certificate" if certificate is None else "tls_key"
        raise SettingsError(
            f"setting {missing!r} is missing: HTTPS needs both tls_certificate and tls_key", setting=missing
        )
    for name, path in (("tls_certificate", certificate), ("tls_key", key)):
        try:
            path.open("rb").close()
        except OSError as error:
            raise SettingsError(f"setting {name!r}: {path} cannot be read: {error.strerror}", setting=name) from error

    def passphrase() -> str:  # else OpenSSL would ask for it on the terminal
        raise SettingsError(
            f"setting 'tls_key': {key} is protected by a passphrase; give one that is not", setting="tls_key"
        )

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)  # TLS 1.2 or newer
    try:
        context.load_cert_chain(certificate, key, passphrase)
    except ssl.SSLError as error:
        raise SettingsError(
            f"settings 'tls_certificate' and 'tls_key': {certificate} and {key} are no PEM files that belong "
            f"together: {error.reason or error}",
            setting="tls_certificate",
        ) from error
    context.set_alpn_protocols(["http/1.1"])
    return context


def loop_for_tls(handshake_timeout_s: float) -> Callable[[], asyncio.AbstractEventLoop]:
    """Makes event loops whose servers close a connection that has not shaken hands in this time.

    A protocol only hears of a connection after the handshake, and uvicorn passes no timeout on.
    """

    class Loop(_Loop):
        async def create_server(self, *args: Any, **kwargs: Any) -> Any:
            if kwargs.get("ssl") is not None:
                kwargs |= {"ssl_handshake_timeout": handshake_timeout_s, "ssl_shutdown_timeout": _SHUTDOWN_TIMEOUT_S}
            return await super().create_server(*args, **kwargs)

    return Loop
