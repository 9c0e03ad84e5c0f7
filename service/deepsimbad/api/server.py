"""Serving the application with uvicorn, and its log: one JSON object a line, or plain lines for a person."""

import gc
import json
import logging
import logging.config
import signal
import socket
import ssl
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from threadpoolctl import threadpool_limits

from deepsimbad import release
from deepsimbad.api.app import create_app
from deepsimbad.errors import SettingsError, UnavailableError
from deepsimbad.jobs.child import extras
from deepsimbad.settings import Settings
from deepsimbad.store.layout import catalog_path

log = logging.getLogger(__name__)

_LONGEST_HOLD_S = 0.0005  # of the interpreter while others wait: at Python's 5 ms encoders stand still beside an answer
_ENCODER = json.JSONEncoder(default=str)


class JsonFormatter(logging.Formatter):
    """One line a record: time, level, logger, message, and the `extra` fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Render a record."""
        line = {
            "time": f"{_second(int(record.created))}.{int(record.msecs):03d}Z",
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= extras(record)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return _ENCODER.encode(line)


class PlainFormatter(logging.Formatter):
    """One line a record for a person at a terminal: time, level above INFO, message, `extra` fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Render a record."""
        fields = [f"{name}={value}" for name, value in extras(record).items() if value not in (None, {}, [])]
        level = "" if record.levelno <= logging.INFO else f"{record.levelname}: "
        clock_time = time.strftime("%H:%M:%S", time.localtime(record.created))
        line = "  ".join([f"{clock_time}  {level}{record.getMessage()}", *fields])
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


@lru_cache(maxsize=2)
def _second(since_1970: int) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(since_1970))


def configure_logging(level: str) -> None:
    """Send everything at `level` and above to standard error, uvicorn's own lines too.

    As JSON lines; where that is a terminal, as a person reads them.
    """
    form = PlainFormatter if sys.stderr.isatty() else JsonFormatter
    # No line of ours shows these, and every record would look them up.
    logging.logThreads = logging.logProcesses = logging.logMultiprocessing = False
    if sys.version_info >= (3, 12):
        logging.logAsyncioTasks = False
    logging.config.dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"lines": {"()": form}},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "lines"}},
            "root": {"level": "WARNING", "handlers": ["stderr"]},
            "loggers": {
                "deepsimbad": {"level": level},
                "uvicorn": {"level": level, "handlers": [], "propagate": True},
                "uvicorn.error": {"level": level},
                # One line a request is ours, with its id; uvicorn's would be a second.
                "uvicorn.access": {"level": "WARNING"},
            },
        }
    )


class _Server(uvicorn.Server):
    """Logs that it listens, and tells the application of a shutdown, so that event streams do not hold it up."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Finish the requests under way and stop; after a second signal stop at once."""
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
        gc.collect()
        gc.freeze()  # what is there stays, and looking through it again would stop all answers for a tenth of a second
        sys.setswitchinterval(_LONGEST_HOLD_S)
        addresses = [listener.getsockname()[:2] for server in self.servers for listener in server.sockets]
        host, port = addresses[0]
        url_host = "localhost" if host in {"0.0.0.0", "::"} else f"[{host}]" if ":" in host else host  # noqa: S104
        url = f"{'https' if self.config.is_ssl else 'http'}://{url_host}:{port}"
        pages = {"console": f"{url}/console", "docs": f"{url}/docs"}
        log.info("ready", extra={"addresses": [f"{host}:{port}" for host, port in addresses], "url": url, **pages})

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End connections and requests, then the application, whose files are closed even where nobody waits."""
        await super().shutdown(sockets)
        if self.force_exit:
            for task in self.server_state.tasks:
                task.cancel()
            await self.lifespan.shutdown()


def http_config(app: Callable[..., Any], settings: Settings) -> uvicorn.Config:
    """How an ASGI application is served over HTTP; raises SettingsError where the TLS files are unusable."""
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        http="h11",  # the one that bounds a request's head
        ws="none",
        h11_max_incomplete_event_size=settings.max_header_bytes,
        limit_concurrency=settings.max_connections,
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=settings.shutdown_grace_s,
        ssl_certfile=settings.tls_certificate,
        ssl_keyfile=settings.tls_key,
        ssl_keyfile_password="",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
    )
    try:
        if settings.tls_key is not None and settings.tls_certificate is None:
            raise FileNotFoundError("tls_certificate is missing")
        config.load()
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(
            f"settings 'tls_certificate' and 'tls_key': {settings.tls_certificate} and {settings.tls_key} are no PEM "
            f"files that can be read, belong together and need no passphrase: {error}",
            setting="tls_certificate",
        ) from error
    return config


def cannot_listen(settings: Settings, error: OSError) -> UnavailableError:
    """The error for an address that is in use, or is not one of this machine's."""
    reason = (error.strerror or str(error)).rpartition("): ")[2]  # asyncio repeats the address
    return UnavailableError(
        f"cannot listen on {settings.host}:{settings.port}: {reason}; --host and --port name another address"
    )


def serve(settings: Settings, create: bool = False) -> None:
    """Serve until a signal ends it; requests under way are finished first.

    Args:
        settings: The settings.
        create: Whether a data directory that is not there is made.

    Raises:
        SettingsError: It would be open to other machines, the data directory is not there, or TLS files are unusable.
        DeepSimbadError: It could not start; the error names the cause.
    """
    if not catalog_path(settings.data_dir).is_file():  # then there is no key, and no need to make the folder first
        settings.check_exposure(n_keys=0)
    if not (create or settings.data_dir.exists()):
        raise SettingsError(
            f"there is no data directory {settings.data_dir}: make it with `deepsimbad init` or `serve --create`, or "
            "name another with --data-dir",
            setting="data_dir",
        )
    configure_logging(settings.log_level)
    changed_settings = {  # none of them is a secret
        name: str(value) if isinstance(value, Path) else value
        for name, field in Settings.model_fields.items()
        if name != "data_dir" and (value := getattr(settings, name)) != field.default
    }
    data_dir = str(settings.data_dir.resolve())
    log.info("starting", extra={"version": release(), "data_dir": data_dir, "settings": changed_settings})
    app = create_app(settings)
    config = http_config(app, settings)

    def is_news(record: logging.LogRecord) -> bool:
        """Whether a record is no stack trace of a named error, which the caller gets anyway."""
        return not (hasattr(app.state, "startup_error") and record.getMessage().startswith("Traceback"))

    logging.getLogger("uvicorn.error").addFilter(is_news)
    try:
        # A product of a view with its landmarks is short, and wakes OpenBLAS's threads, which then spin for 20 ms on
        # the core that the next view wants. Jobs compute in processes of their own.
        with threadpool_limits(1, user_api="blas"):
            _Server(config, app).run()
    except SystemExit as ended:  # how uvicorn says that it could not start
        cause = ended.__context__
        if isinstance(cause, OSError):
            raise cannot_listen(settings, cause) from cause
        unknown_error = UnavailableError("the service could not start: the log says why")
        raise getattr(app.state, "startup_error", unknown_error) from ended
