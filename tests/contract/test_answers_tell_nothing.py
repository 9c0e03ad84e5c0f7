"""No answer tells where files lie, what our code looks like inside, or what a library said."""

import json
import shutil
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess

from .conftest import NPZ, make_ready_domain, npz, small_settings, wait_for

JSON = {"Content-Type": "application/json"}
NAMES = {"domain": "ready", "name": "drive", "index": "0", "version": "1", "session_id": "none", "job_id": "none"}
BODIES: tuple[tuple[bytes, dict[str, str]], ...] = (
    (b"", {}),
    (b"", JSON),
    (b"{}", JSON),
    (b"[" * 40_000, JSON),
    (b'{"encoding": [1e999, NaN]}', JSON),
    (b'{"name": "../../x", "evaluator": {"kind": "/etc/passwd"}}', JSON),
    (b'"\xff\xfe"', JSON),
    (b"x" * 60_000, JSON),
    (b"not an image", {"Content-Type": "image/png"}),
    (b"PK\x03\x04 not an archive", NPZ),
    (b"a=1", {"Content-Type": "application/x-www-form-urlencoded"}),
    (b"{}", {**JSON, "Content-Encoding": "gzip"}),
)
QUERIES = (
    "",
    "position_m=nan",
    "position_m=0&timestamp_us=99999999999999999999",
    "shortlist=-1",
    "after=%00",
    "limit=x",
)


INSIDE = ("Traceback", 'File "', "sqlite3.", "OperationalError", "site-packages", " deepsimbad.", "<class", "0x7f")


class Telling:
    """Checks answers, and counts those with an error."""

    def __init__(self, data_dir: Path) -> None:
        self.n_errors = 0
        self._places = (data_dir.name, str(data_dir.resolve().parent), str(Path(__file__).parents[2]))

    def check(self, answer: Any) -> None:
        is_error = answer.status_code >= 400
        self.n_errors += is_error
        told = answer.text + json.dumps(dict(answer.headers))
        for each in (*self._places, *(INSIDE if is_error else ())):
            assert each not in told, f"{each}: {answer.request.method} {answer.request.url}: {told[:1000]}"


@pytest.fixture
def ours(tmp_path: Path) -> Iterator[tuple[TestClient, Path, Telling]]:
    data_dir = tmp_path / "somewhere-secret"
    app = create_app(small_settings(data_dir), InThisProcess(data_dir))
    with TestClient(app, raise_server_exceptions=False) as client:
        make_ready_domain(client, "ready")
        yield client, data_dir, Telling(data_dir)


def walk(client: TestClient, telling: Telling) -> None:
    """Every operation, with and without what it needs."""
    for path, by_method in client.get("/openapi.json").json()["paths"].items():
        for method, operation in by_method.items():
            bodies = BODIES if "requestBody" in operation else BODIES[:1]
            for names, (body, headers), query in product((NAMES, dict.fromkeys(NAMES, "unknown")), bodies, QUERIES):
                if method == "delete" and names is NAMES:
                    continue
                url = f"{path.format(**names)}?{query}"
                telling.check(client.request(method.upper(), url, content=body, headers=headers))
        telling.check(client.request("PATCH", path.format(**NAMES)))


def test_mistakes(ours: tuple[TestClient, Path, Telling]) -> None:
    client, _, telling = ours
    walk(client, telling)
    for path in ("/no/such/path", "/v1", "/v1/", "/%00", "/docs/x", "/..%2f..%2fetc/passwd"):
        telling.check(client.get(path))
    assert telling.n_errors > 500


def damage(path: Path) -> None:
    path.chmod(0o644)
    content = bytearray(path.read_bytes())
    for place in range(100, len(content), 97):
        content[place] ^= 0xFF
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("harm", ["damaged", "missing", "a folder", "empty"])
def test_harmed_files(ours: tuple[TestClient, Path, Telling], harm: str) -> None:
    client, data_dir, telling = ours
    begun = client.post("/v1/domains/ready/sessions", json={}).json()["session_id"]
    assert client.post("/v1/admin/domains/ready/traverses", json={"name": "other"}).status_code == 201
    harmed = [*data_dir.glob("domains/*/traverses/*.sqlite"), *data_dir.glob("domains/*/maps/*.sqlite")]
    assert len(harmed) == 3
    for path in harmed:
        if harm == "damaged":
            damage(path)
        else:
            path.unlink()
        if harm == "a folder":
            path.mkdir()
        if harm == "empty":
            path.touch()
    frame = json.dumps({"encoding": [0.0] * 8})
    for method, path, body, headers in (
        ("GET", "/v1/admin/domains/ready/traverses", "", {}),
        ("GET", "/v1/admin/domains/ready/traverses/drive", "", {}),
        ("PUT", "/v1/admin/domains/ready/traverses/other/frames/0?position_m=0", frame, JSON),
        ("POST", "/v1/admin/domains/ready/traverses/other/frames", npz(encodings=[[0.0] * 8], index=[0]), NPZ),
        ("PUT", "/v1/admin/domains/ready/active-map", '{"version": 1}', JSON),
        ("GET", "/v1/admin/domains/ready/maps/1/file", "", {}),
        ("GET", "/v1/admin/domains/ready/maps", "", {}),
        ("GET", "/v1/domains/ready", "", {}),
        ("GET", "/readyz", "", {}),
        ("GET", "/metrics", "", {}),
        ("POST", f"/v1/sessions/{begun}/observations", '{"ranked_landmarks": [1]}', JSON),
        ("POST", "/v1/admin/domains/ready/remaps", '{"training_traverse": "drive"}', JSON),
    ):
        answer = client.request(method, path, content=body, headers=headers)
        telling.check(answer)
        if answer.status_code == 202:
            job = wait_for(client, answer.json()["job_id"])
            telling.check(client.get(f"/v1/admin/jobs/{job['job_id']}"))
            telling.check(client.get(f"/v1/admin/jobs/{job['job_id']}/events"))
    assert telling.n_errors >= 3


@pytest.mark.slow
def test_a_catalog_and_sessions_that_are_gone(ours: tuple[TestClient, Path, Telling]) -> None:
    client, data_dir, telling = ours
    app: Any = client.app
    app.state.services.catalog.close()
    app.state.services.session_store.close()
    shutil.rmtree(data_dir)
    walk(client, telling)
    assert telling.n_errors > 500
