"""Every operation of the OpenAPI document, tried by schemathesis: the document is true, and no answer is our own fault.

The command runs against a live server, in its own process. `SCHEMATHESIS_EXAMPLES` (8) says how many cases an
operation gets in the fuzzing and stateful phases; the examples and coverage phases try what the document holds.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope

from .conftest import N_SEEN, encoded, make_ready_domain, picture, remap, small_settings
from .served import free_port

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

EXAMPLES = int(os.environ.get("SCHEMATHESIS_EXAMPLES", "8"))
FEWEST_CASES = 1500
HOOKS = Path(__file__).with_name("schemathesis_hooks.py")
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
    "missing_required_header",
    "unsupported_method",
    "allow_header_conformance",
    "use_after_free",
    "ensure_resource_availability",
)
# The examples of the document are there, so that most requests get behind the names; what makes and deletes domains
# leaves the mapped one alone.
CONFIG = """
hooks = {hooks}
[generation]
deterministic = true
[checks]
not_a_server_error.expected-statuses = ["2xx", "3xx", "4xx", "503"]
negative_data_rejection.expected-statuses = ["4xx", "503"]
# What is drawn at random may be wrong only in a header that an open service ignores, or in a list that leaves no trace.
[phases]
fuzzing.checks.negative_data_rejection.enabled = false
stateful.checks.negative_data_rejection.enabled = false

[dictionaries]
mapped.values = ["campus"]
spare.values = ["spare", "other"]
drives.values = ["2012-08-20", "2012-05-11"]
versions.values = [1, 2]

[parameters]
"path.domain" = {{ dictionary = "mapped", probability = 0.7 }}
"path.name" = {{ dictionary = "drives", probability = 0.5 }}
"path.version" = {{ dictionary = "versions", probability = 0.7 }}
"query.domain" = {{ dictionary = "mapped", probability = 0.5 }}
"body.training_traverse" = {{ dictionary = "drives", probability = 0.7 }}
"body.landmark_traverse" = {{ dictionary = "drives", probability = 0.5 }}

[[operations]]
include-name = "PUT /v1/admin/domains/{{domain}}"
parameters = {{ "path.domain" = {{ dictionary = "spare", probability = 1.0 }} }}
[[operations]]
include-name-regex = "^DELETE /v1/admin/domains/[^/]*(/traverses/.*)?$"
parameters = {{ "path.domain" = "spare" }}
"""
SERVE = """
import sys
from functools import partial
from pathlib import Path
from deepsimbad.api import server
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings
data_dir = Path(sys.argv[1])
# A hundred processes for a hundred tiny jobs would only take the time of the requests.
server.create_app = partial(server.create_app, run_job=InThisProcess(data_dir))
server.serve(Settings(data_dir=data_dir, port=int(sys.argv[2]), event_poll_s=0.01, rate_limit_per_s=0))
"""


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory in which the examples of the document are there: a domain mapped twice, its drives."""
    folder = tmp_path_factory.mktemp("prepared") / "data"
    drives = ("2012-05-11", "2012-08-20")
    with TestClient(create_app(small_settings(folder), InThisProcess(folder))) as client:
        make_ready_domain(client, "spare")
        client.put("/v1/admin/domains/campus", json={"evaluator": {"kind": "feature_l2"}})
        for name in drives:
            client.post("/v1/admin/domains/campus/traverses", json={"name": name})
            for index in range(N_SEEN):
                stored = client.put(
                    f"/v1/admin/domains/campus/traverses/{name}/frames/{index}",
                    params={"position_m": index},
                    content=encoded(picture(index)),
                    headers={"Content-Type": "image/jpeg"},
                )
                assert stored.status_code == 201, stored.text
        for name in drives:
            job = remap(
                client, "campus", training_traverse=name, landmark_traverse=name, n_landmarks=N_SEEN, list_length=3
            )
            assert job["state"] == "succeeded", job
    return folder


@contextmanager
def served(data_dir: Path) -> Iterator[str]:
    """The address of a service on a data directory, which must outlive what is done to it."""
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    log = data_dir.parent / "log"
    with log.open("wb") as stderr:
        process = subprocess.Popen([sys.executable, "-c", SERVE, str(data_dir), str(port)], stderr=stderr)
    try:
        for _ in range(600):
            try:
                if httpx2.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx2.TransportError:
                time.sleep(0.1)
            assert process.poll() is None, log.read_text()
        yield url
        assert process.poll() is None, log.read_text()
        assert httpx2.get(f"{url}/readyz").status_code == 200
        assert '"request failed"' not in log.read_text()
        process.terminate()
        assert process.wait(60) == 0, log.read_text()
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


def schemathesis(url: str, folder: Path, *checks: str, config: str = "", examples: int = EXAMPLES) -> dict[str, Any]:
    """Run the command; the report, after checking that it found nothing and left nothing out."""
    folder.mkdir()
    (folder / "schemathesis.toml").write_text(CONFIG.format(hooks=json.dumps(str(HOOKS))) + config)
    report = folder / "report.json"
    ran = subprocess.run(
        [
            Path(sys.executable).with_name("schemathesis"),
            "--config-file=schemathesis.toml",
            "run",
            f"{url}/openapi.json",
            f"--checks={','.join((*CHECKS, *checks))}",
            f"--max-examples={examples}",
            "--continue-on-failure",
            "--no-shrink",
            "--request-timeout=30",
            "--report=json",
            f"--report-json-path={report}",
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert report.exists(), ran.stdout + ran.stderr
    found: dict[str, Any] = json.loads(report.read_text())
    assert (found["failures"], found["errors"]) == ([], []), ran.stdout
    assert ran.returncode == 0, ran.stdout
    assert found["complete"]
    assert found["operations"]["tested"] == found["operations"]["total"] == n_operations(url)
    return found


def n_operations(url: str) -> int:
    return sum(len(by_method) for by_method in httpx2.get(f"{url}/openapi.json").json()["paths"].values())


def n_cases(report: dict[str, Any]) -> int:
    count: int = report["test_cases"]["generated"]
    print(f"{count} cases, {report['operations']['tested']} operations, {report['running_time']:.0f} s")
    return count


def test_an_open_service(prepared: Path, tmp_path: Path) -> None:
    data_dir = tmp_path / "data"
    shutil.copytree(prepared, data_dir)
    with served(data_dir) as url:
        report = schemathesis(url, tmp_path / "run")
    assert {name: phase["status"] for name, phase in report["phases"].items()} == dict.fromkeys(
        ("examples", "coverage", "fuzzing", "stateful"), "success"
    )
    assert n_cases(report) >= FEWEST_CASES


def test_a_service_with_keys(prepared: Path, tmp_path: Path) -> None:
    data_dir = tmp_path / "data"
    shutil.copytree(prepared, data_dir)
    with Catalog.open(data_dir) as catalog:
        _, admin = catalog.create_key(KeyScope.ADMIN)
        _, robot = catalog.create_key(KeyScope.LOCALIZE)
    total = 0
    with served(data_dir) as url:
        for name, key in (("admin", admin.text), ("localize", robot.text), ("none", None)):
            config = "" if key is None else f'[auth.openapi.bearer]\nbearer = "{key}"\n'
            examples = EXAMPLES if name == "admin" else max(1, EXAMPLES // 5)
            total += n_cases(schemathesis(url, tmp_path / name, "ignored_auth", config=config, examples=examples))
    assert total >= FEWEST_CASES
