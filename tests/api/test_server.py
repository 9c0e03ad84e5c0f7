"""A service that cannot start says why; over TLS it serves; its log lines are JSON, whatever is in them."""

import asyncio
import gc
import json
import logging
import os
import re
import socket
import ssl
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import httpx2
import pytest
import uvicorn
from fastapi import FastAPI

from deepsimbad.api.server import JsonFormatter, PlainFormatter, _Server, configure_logging, serve
from deepsimbad.errors import SettingsError, UnavailableError
from deepsimbad.settings import Settings
from tests.contract.conftest import wait_until
from tests.fork_server import Popen

FILES = Path(__file__).parent / "tls"
pytestmark = pytest.mark.usefixtures("_logging_as_before")
CERTIFICATE, KEY = FILES / "certificate.pem", FILES / "key.pem"


def test_a_data_directory_that_is_none(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(UnavailableError):
        serve(Settings(data_dir=tmp_path / "file", port=0))


@pytest.mark.parametrize(
    ("host", "reason"),
    [("192.0.2.1", "assign requested address"), ("no.such.host.invalid", r"name|resolution|service")],
)
def test_an_address_that_is_not_ours(tmp_path, host, reason):
    with pytest.raises(UnavailableError, match=f"cannot listen on {host}:0: .*(?i:{reason})"):
        serve(Settings(data_dir=tmp_path, host=host, port=0, allow_open=True))


@pytest.mark.parametrize(
    ("certificate", "key"),
    [
        (None, KEY),
        (FILES / "none.pem", KEY),
        (CERTIFICATE, FILES / "none.pem"),
        (CERTIFICATE, FILES / "other_key.pem"),
        (KEY, CERTIFICATE),
        (CERTIFICATE, FILES / "locked_key.pem"),
    ],
)
def test_a_certificate_that_cannot_be_used(tmp_path, certificate, key):
    with pytest.raises(SettingsError, match="tls_certificate") as caught:
        serve(Settings(data_dir=tmp_path / "data", port=0, tls_certificate=certificate, tls_key=key), create=True)
    assert caught.value.hints["setting"] == "tls_certificate"
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_the_service_on_https(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    context = ssl.create_default_context(cafile=CERTIFICATE)
    with (
        Popen(
            [sys.executable, "-m", "deepsimbad", "serve", "--create", "--data-dir", tmp_path, "--port", str(port)],
            env={**os.environ, "DEEPSIMBAD_TLS_CERTIFICATE": str(CERTIFICATE), "DEEPSIMBAD_TLS_KEY": str(KEY)},
            stderr=subprocess.DEVNULL,
            cwd=tmp_path,
        ) as process,
        httpx2.Client(base_url=f"https://localhost:{port}", verify=context, timeout=60, trust_env=False) as client,
    ):

        def is_ready():
            with suppress(httpx2.TransportError):
                return client.get("/readyz").status_code == 200

        try:
            wait_until(is_ready)
        finally:
            process.kill()


def test_what_is_there_at_the_start_is_not_looked_through_again():
    async def frozen_while_it_serves():
        server = _Server(uvicorn.Config(FastAPI(), port=0, lifespan="off", log_config=None), FastAPI())
        task = asyncio.create_task(server.serve())
        while not server.started:
            await asyncio.sleep(0.01)
        server.should_exit = True
        await task
        return gc.get_freeze_count()

    try:
        assert asyncio.run(frozen_while_it_serves()) > 10_000
    finally:
        gc.unfreeze()


def test_a_line_holds_message_extras_and_exception():
    record = logging.LogRecord("a.b", logging.WARNING, "file", 1, "two %s", ("words",), None)
    record.request_id = "r1"
    record.odd = {1, 2}
    line = json.loads(JsonFormatter().format(record))
    assert line["time"].endswith("Z")
    assert {**line, "time": ""} == {
        "time": "",
        "level": "WARNING",
        "logger": "a.b",
        "message": "two words",
        "request_id": "r1",
        "odd": "{1, 2}",
    }
    try:
        raise ValueError("lone \ud800\nsurrogate")
    except ValueError as error:
        record.exc_info = (ValueError, error, error.__traceback__)
    line = JsonFormatter().format(record)
    assert "\n" not in line
    assert line.isascii()
    assert "ValueError" in json.loads(line)["exception"]


def test_on_a_terminal_lines_are_for_people(monkeypatch, capsys):
    record = logging.makeLogRecord({"levelno": logging.INFO, "levelname": "INFO", "msg": "ready", "url": "http://a:1"})
    assert re.fullmatch(r"\d\d:\d\d:\d\d  ready  url=http://a:1", PlainFormatter().format(record))
    record.levelno, record.levelname = logging.WARNING, "WARNING"
    assert "  WARNING: ready  url=" in PlainFormatter().format(record)
    for is_terminal, form in ((True, PlainFormatter), (False, JsonFormatter)):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        configure_logging("INFO")
        (handler,) = logging.getLogger().handlers[-1:]
        assert isinstance(handler.formatter, form)


def test_configuring_keeps_uvicorns_access_lines_out():
    configure_logging("ERROR")
    assert not logging.getLogger("uvicorn.access").isEnabledFor(logging.INFO)
    assert not logging.getLogger("deepsimbad").isEnabledFor(logging.WARNING)
