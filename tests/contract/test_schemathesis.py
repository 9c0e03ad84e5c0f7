"""Every operation of the OpenAPI document, tried by schemathesis: the document is true, and no answer is our own fault.

The command runs against a live server, in its own process, with an admin's key; what others may is test_keys' matter.
`SCHEMATHESIS_EXAMPLES` (8) says how many cases an operation gets in the fuzzing and stateful phases; examples and
coverage try what the document holds.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import httpx2
import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope

from .conftest import N_SEEN, TAKES_IMAGES, service
from .server_process import ServerProcess

pytestmark = pytest.mark.slow

EXAMPLES = os.environ.get("SCHEMATHESIS_EXAMPLES", "8")
FEWEST_CASES = 1500
ENDLESS = "/v1/sessions/{session_id}/events"  # as long as the session lives: no case of it would end
HOOKS = Path(__file__).with_name("schemathesis_hooks.py")
PHASES = ("examples", "coverage", "fuzzing", "stateful")
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
    "ignored_auth",
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
import os, sys
from functools import partial
from pathlib import Path
from deepsimbad.api import server
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings
data_dir = Path(sys.argv[1])
# Jobs in this process: a hundred processes for a hundred tiny jobs would only take the time of the requests.
settings = Settings(data_dir=data_dir, port=int(sys.argv[-1]), event_poll_s=0.01, rate_limit_per_s=0)
if "TEST_FLEET" in os.environ:
    from tests.fleet.running import application, cluster
    cluster()
    settings = settings.model_copy(update={"map_store": f"file://{data_dir}-store"})
    application.start(application.build(settings, 2, InThisProcess))
    application.wait()
else:
    server.create_app = partial(server.create_app, run_job=InThisProcess(data_dir))
    server.serve(settings)
"""


def prepare(data_dir):
    """Make what the examples of the document are about: a domain mapped twice, its drives."""
    with service(data_dir) as client:
        client.make_ready_domain("spare")
        client.make_domain("campus", **TAKES_IMAGES)
        for name in ("2012-05-11", "2012-08-20"):
            assert client.upload_pictures("campus", name) == [201] * N_SEEN
            drives = {"training_traverse": name, "landmark_traverse": name}
            client.make_map("campus", **drives, n_landmarks=N_SEEN, list_length=3)


def schemathesis(url, folder, key):
    """Run the command, which must find nothing and leave nothing out; how many cases it tried."""
    auth = f'[auth.openapi.bearer]\nbearer = "{key}"\n'
    (folder / "schemathesis.toml").write_text(CONFIG.format(hooks=json.dumps(str(HOOKS))) + auth)
    report = folder / "report.json"
    command = [Path(sys.executable).with_name("schemathesis"), "--config-file=schemathesis.toml", "run"]
    options = [f"--checks={','.join(CHECKS)}", f"--phases={','.join(PHASES)}", f"--max-examples={EXAMPLES}"]
    options += [f"--exclude-path={ENDLESS}", "--no-shrink"]
    options += ["--continue-on-failure", "--request-timeout=30", "--report=json", f"--report-json-path={report}"]
    process = subprocess.run(
        [*command, f"{url}/openapi.json", *options], cwd=folder, capture_output=True, text=True, check=False
    )
    assert report.exists(), process.stdout + process.stderr
    results = json.loads(report.read_text())
    assert (results["failures"], results["errors"], results["complete"]) == ([], [], True), process.stdout
    assert process.returncode == 0, process.stdout
    phase_statuses = {name: phase["status"] for name, phase in results["phases"].items() if name in PHASES}
    assert phase_statuses == dict.fromkeys(PHASES, "success")
    n_operations = sum(len(by_method) for by_method in httpx2.get(f"{url}/openapi.json").json()["paths"].values())
    assert results["operations"]["tested"] >= n_operations - 1
    n_cases = results["test_cases"]["generated"]
    print(f"{n_cases} cases, {n_operations} operations, {results['running_time']:.0f} s")
    return n_cases


def test_a_service_with_keys(tmp_path):
    data_dir = tmp_path / "data"
    prepare(data_dir)
    with Catalog.open(data_dir) as catalog:
        _, admin = catalog.create_key(KeyScope.ADMIN)
    with ServerProcess(data_dir, SERVE) as server:
        assert schemathesis(server.url, tmp_path, admin.text) >= FEWEST_CASES
        assert server.client.get("/readyz").status_code == 200
        assert '"request failed"' not in server.log_path.read_text()
        os.kill(server.pid, signal.SIGTERM)
        assert server.wait(60) == 0, server.log_path.read_text()
