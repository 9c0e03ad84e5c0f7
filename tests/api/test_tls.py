"""HTTPS from the settings: named errors for what cannot be used, and connections that nobody finishes."""

import asyncio
import json
import os
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from deepsimbad.api.tls import loop_for_tls, tls_context
from deepsimbad.errors import SettingsError

FILES = Path(__file__).parent / "tls"
CERTIFICATE, KEY = FILES / "certificate.pem", FILES / "key.pem"


def test_neither_is_http() -> None:
    assert tls_context(None, None) is None


def test_both_are_https() -> None:
    context = tls_context(CERTIFICATE, KEY)
    assert context is not None
    assert context.minimum_version >= ssl.TLSVersion.TLSv1_2


@pytest.mark.parametrize(
    ("certificate", "key", "setting", "words"),
    [
        (CERTIFICATE, None, "tls_key", "missing"),
        (None, KEY, "tls_certificate", "missing"),
        (FILES / "none.pem", KEY, "tls_certificate", "none.pem cannot be read: No such file"),
        (CERTIFICATE, FILES / "none.pem", "tls_key", "none.pem cannot be read: No such file"),
        (FILES, KEY, "tls_certificate", "cannot be read: Is a directory"),
        (CERTIFICATE, FILES / "other_key.pem", "tls_certificate", "belong together"),
        (KEY, CERTIFICATE, "tls_certificate", "belong together"),
        (Path(__file__), KEY, "tls_certificate", "belong together"),
        (CERTIFICATE, FILES / "locked_key.pem", "tls_key", "passphrase"),
    ],
)
def test_what_cannot_be_used_is_named(certificate: Path | None, key: Path | None, setting: str, words: str) -> None:
    with pytest.raises(SettingsError, match=words) as caught:
        tls_context(certificate, key)
    assert caught.value.hints["setting"] == setting
    assert setting in caught.value.message


def test_a_handshake_that_nobody_finishes() -> None:
    async def wait() -> bytes:
        loop = asyncio.get_running_loop()
        server = await loop.create_server(asyncio.Protocol, "127.0.0.1", 0, ssl=tls_context(CERTIFICATE, KEY))
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        writer.write(b"\x16\x03\x01")
        received = await asyncio.wait_for(reader.read(), 20)  # far sooner than the loop's own minute
        writer.close()
        server.close()
        return received

    with asyncio.Runner(loop_factory=loop_for_tls(0.2)) as runner:
        assert runner.run(wait()) == b""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Of a service on HTTPS."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        found: int = probe.getsockname()[1]
    settings = {"TLS_CERTIFICATE": CERTIFICATE, "TLS_KEY": KEY, "HEADER_TIMEOUT_S": 1}
    process = subprocess.Popen(
        [sys.executable, "-m", "deepsimbad", "serve", "--data-dir", str(tmp_path / "data"), "--port", str(found)],
        env={**os.environ, **{f"DEEPSIMBAD_{name}": str(value) for name, value in settings.items()}},
        stderr=subprocess.DEVNULL,
        cwd=tmp_path,
    )
    try:
        yield found
        process.terminate()
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_the_service_on_https(port: int) -> None:
    context = ssl.create_default_context(cafile=CERTIFICATE)
    context.set_alpn_protocols(["h2", "http/1.1"])

    def tell(content: bytes) -> bytes:
        with (
            socket.create_connection(("127.0.0.1", port), timeout=20) as connection,
            context.wrap_socket(connection, server_hostname="localhost") as secured,
        ):
            assert secured.selected_alpn_protocol() == "http/1.1"
            secured.sendall(content)
            received = b""
            while more := secured.recv(65536):
                received += more
            return received

    for _ in range(600):
        try:
            answer = tell(b"GET /readyz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            break
        except OSError:
            time.sleep(0.1)
    assert answer.startswith(b"HTTP/1.1 200 ")
    late = tell(b"GET / HTTP/1.1\r\n")
    assert late.startswith(b"HTTP/1.1 408 ")
    assert json.loads(late.partition(b"\r\n\r\n")[2])["code"] == "request_timeout"
    with socket.create_connection(("127.0.0.1", port), timeout=20) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with suppress(ConnectionError):
            assert not plain.recv(65536).startswith(b"HTTP/")
    with socket.create_connection(("127.0.0.1", port), timeout=20) as silent:
        assert silent.recv(65536) == b""


def test_serve_says_which_file_it_cannot_use(tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "deepsimbad", "serve", "--data-dir", str(tmp_path / "data"), "--port", "0"],
        env={**os.environ, "DEEPSIMBAD_TLS_CERTIFICATE": str(CERTIFICATE), "DEEPSIMBAD_TLS_KEY": "/nowhere/key.pem"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ran.returncode == 1
    assert len(ran.stderr.splitlines()) == 2, "a record of the log, and the line that every named error is"
    assert "tls_key" in ran.stderr.splitlines()[-1]
    assert not (tmp_path / "data").exists()
