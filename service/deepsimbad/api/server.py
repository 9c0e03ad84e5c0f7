"""Serving the application with uvicorn."""

import asyncio
import logging
import signal
import socket
import ssl
from collections.abc import Callable
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI

from deepsimbad.api.app import create_app
from deepsimbad.api.logs import configure_logging
from deepsimbad.api.open_files import allow_open_files
from deepsimbad.api.protocol import WireLimits, protocol_class
from deepsimbad.api.tls import loop_for_tls, tls_context
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.release import release
from deepsimbad.settings import Settings
from deepsimbad.store.layout import catalog_path

log = logging.getLogger(__name__)


class _Server(uvicorn.Server):
    """Says when it listens, and tells the application of shutdown, so that event streams do not hold it up."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """A signal came: finish what is under way; a second one does not wait."""
        services = getattr(self._app.state, "services", None)
        if services is not None:
            services.stopping.set()
        if self.should_exit:
            self.force_exit = True
        elif sig == signal.SIGTERM:
            self.should_exit = True  # being asked to stop is no failure, so the signal is not raised again
        else:
            super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the application and listen, and say so when both are done."""
        await super().startup(sockets)
        addresses = [listening.getsockname()[:2] for server in self.servers for listening in server.sockets]
        log.info("ready", extra={"addresses": [f"{host}:{port}" for host, port in addresses]})

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End connections and requests, then the application: also where nobody waits, its files are closed."""
        await super().shutdown(sockets)
        if self.force_exit:
            for task in self.server_state.tasks:
                task.cancel()
            await self.lifespan.shutdown()


class _Config(uvicorn.Config):
    """With a loop of ours where connections begin with a handshake."""

    def __init__(self, app: FastAPI, settings: Settings, context: ssl.SSLContext | None, **more: Any) -> None:
        super().__init__(app, ssl_context_factory=None if context is None else lambda *_: context, **more)
        self._handshake_timeout_s = None if context is None else settings.header_timeout_s

    def get_loop_factory(self) -> Callable[[], asyncio.AbstractEventLoop] | None:
        """What makes the event loop."""
        if self._handshake_timeout_s is None:
            return super().get_loop_factory()
        return loop_for_tls(self._handshake_timeout_s)


def serve(settings: Settings) -> None:
    """Serve until a signal ends it; requests under way are finished first.

    Args:
        settings: The settings.

    Raises:
        SettingsError: The address could be reached from other machines, and the service has no keys; or the
            certificate or its key cannot be used.
        DeepSimbadError: What kept it from starting, by name.
    """
    if not catalog_path(settings.data_dir).is_file():  # then there is no key, and no need to make the folder first
        settings.check_exposure(n_keys=0)
    context = tls_context(settings.tls_certificate, settings.tls_key)
    configure_logging(settings.log_level)
    allow_open_files(settings.max_connections)
    log.info(
        "starting",
        extra={
            "version": release(),
            "data_dir": str(settings.data_dir.resolve()),
            "settings": _changed(settings),
        },
    )
    app = create_app(settings)
    limits = WireLimits(
        header_timeout_s=settings.header_timeout_s,
        stall_timeout_s=settings.stall_timeout_s,
        max_header_bytes=settings.max_header_bytes,
        max_connections=settings.max_connections,
        refused=app.state.metrics.refused,
    )
    config = _Config(
        app,
        settings,
        context,
        http=protocol_class(limits),
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="none",
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=settings.shutdown_grace_s,
    )

    def is_news(record: logging.LogRecord) -> bool:
        """Whoever called gets the named error; its stack in the log would only hide it."""
        return not (hasattr(app.state, "startup_error") and record.getMessage().startswith("Traceback"))

    logging.getLogger("uvicorn.error").addFilter(is_news)
    try:
        _Server(config, app).run()
    except SystemExit as ended:  # how uvicorn says that it could not start
        why: DeepSimbadError | None = getattr(app.state, "startup_error", None)
        if why is None:
            why = UnavailableError(f"cannot listen on {settings.host}:{settings.port}: is the port taken?")
        raise why from ended


def _changed(settings: Settings) -> dict[str, Any]:
    """The settings that are not as they come; none of them is a secret."""
    return {
        name: getattr(settings, name)
        for name, field in Settings.model_fields.items()
        if name != "data_dir" and getattr(settings, name) != field.default
    }
