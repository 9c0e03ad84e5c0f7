"""A service that cannot start says why."""

import logging
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from deepsimbad.api.server import serve
from deepsimbad.errors import UnavailableError
from deepsimbad.settings import Settings


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    names = (None, "deepsimbad", "uvicorn", "uvicorn.error", "uvicorn.access")
    kept = [(logging.getLogger(name), logging.getLogger(name).level) for name in names]
    handlers = logging.getLogger().handlers[:]
    yield
    logging.getLogger().handlers[:] = handlers
    for logger, level in kept:
        logger.setLevel(level)


def test_a_data_directory_that_is_none(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(UnavailableError):
        serve(Settings(data_dir=tmp_path / "file", port=0))
    assert "Traceback" not in capfd.readouterr().err


def test_a_port_that_is_taken(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UnavailableError, match=f"cannot listen on 127.0.0.1:{port}"):
            serve(Settings(data_dir=tmp_path, port=port))
