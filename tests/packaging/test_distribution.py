"""What is shipped: the bare wheel is the client alone and works; the service's parts are in it, asked for by extras."""

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "deepsimbad": "service",
    "deepsimbad_client": "client",
    "deepsimbad_campus": "client",
    "deepsimbad_migrations": "migrations",
}
HEAVY = ("numpy", "cv2", "torch", "numba", "fastapi", "uvicorn", "click", "matplotlib", "sqlite_utils")

pytestmark = pytest.mark.slow


def run(*command, **options):
    process = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, **options)
    assert process.returncode == 0, f"{command} ended with {process.returncode}:\n{process.stdout}\n{process.stderr}"
    return process.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from the sdist."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, PROJECT)
    (sdist,), (path,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    with tarfile.open(sdist) as archive:
        names = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    shipped = {"pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE", "PKG-INFO", ".gitignore"}
    assert names == {*shipped, *PACKAGES.values()}
    return path


@pytest.fixture(scope="module")
def bare(wheel, tmp_path_factory):
    """The folder of programs of a fresh environment that holds the bare wheel."""
    folder = tmp_path_factory.mktemp("bare") / "env"
    venv.create(folder)
    run(
        *(sys.executable, "-m", "pip", "--python", folder / "bin" / "python", "install", "--no-compile", "--quiet"),
        *("--disable-pip-version-check", "--constraint", PROJECT / "constraints.txt", wheel),
    )
    return folder / "bin"


def test_the_wheel_holds_all_packages_typed_and_licensed(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(name for name in names if name.endswith("/METADATA"))).decode()
        entry_points = archive.read(next(name for name in names if name.endswith("/entry_points.txt"))).decode()
    for package, root in PACKAGES.items():
        sources = {f"{path.relative_to(PROJECT / root)}" for path in (PROJECT / root / package).rglob("*.py")}
        assert sources, package
        assert sources <= names, f"missing: {sorted(sources - names)}"
    assert {f"{package}/py.typed" for package in ("deepsimbad", "deepsimbad_client", "deepsimbad_campus")} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert "License-Expression: MIT" in metadata
    assert "deepsimbad = deepsimbad.__main__:main" in entry_points
    assert "deepsimbad-client = deepsimbad_client.cli:main" in entry_points
    stray = [name for name in names if not name.startswith((*(f"{package}/" for package in PACKAGES), "deep_simbad-"))]
    assert stray == [], "nothing else is shipped"


def test_the_bare_client_talks_to_a_service_without_any_heavy_package(bare):
    """A service of one answer: what counts is that client, transport and models need nothing more."""
    code = """
import importlib.util, json, threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from deepsimbad_client import AsyncClient, Client, errors

class OneAnswer(BaseHTTPRequestHandler):
    def do_GET(self):
        body = json.dumps({"status": "ok"}).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
    def log_message(self, *_):
        pass

server = HTTPServer(("127.0.0.1", 0), OneAnswer)
threading.Thread(target=server.serve_forever, daemon=True).start()
with Client(f"http://127.0.0.1:{server.server_port}") as client:
    print(client.health().status, [name for name in {heavy} if importlib.util.find_spec(name)])
    try:
        client.on_board("campus")
    except errors.MissingExtraError as error:
        print(error)
server.shutdown()
"""
    environment = {"PATH": os.environ["PATH"]}
    first, second = run(
        bare / "python", "-c", code.replace("{heavy}", repr(HEAVY)), cwd=bare, env=environment
    ).splitlines()
    assert first == "ok []"
    assert "pip install 'deep-simbad[edge]'" in second


def test_the_clients_commands_need_nothing_beside_their_extra():
    """Which has no PyTorch or FastAPI: recordings take of the service what takes none of them either."""
    lacking = ("torch", "fastapi", "sqlite_utils", "uvicorn", "rosbags", "scipy")
    code = f"import sys; sys.modules |= dict.fromkeys({lacking}); import deepsimbad_client.commands"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("command", "extra"), [(("deepsimbad-client", "domains"), "replay"), (("deepsimbad", "info", "campus"), "service")]
)
def test_the_commands_of_the_bare_wheel_say_what_they_lack_in_one_line(bare, command, extra):
    process = subprocess.run([bare / command[0], *command[1:]], capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout) == (1, "")
    assert len(process.stderr.splitlines()) == 1, process.stderr
    assert f"pip install 'deep-simbad[{extra}]'" in process.stderr
