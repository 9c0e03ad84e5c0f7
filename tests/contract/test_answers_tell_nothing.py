"""No name in a path reaches the file system, and no answer tells where files lie or what our code looks like inside.

Tricky names go through the application as a server hands them on: percent-encoding undone.
"""

import asyncio
import json
import re
import shutil
from itertools import product
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import pytest

from deepsimbad.store.layout import is_name

from .conftest import DIM, JSON, NAMES, NPZ, npz, operations, service

BODIES = (
    (b"{}", JSON),
    (b"", {}),
    (b"", JSON),
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
    *("position_m=nan", "position_m=0&timestamp_us=99999999999999999999"),
    *("shortlist=-1", "after=%00", "limit=x"),
)
INSIDE = ("Traceback", 'File "', "sqlite3.", "OperationalError", "site-packages", " deepsimbad.", "<class", "0x7f")


class Listener:
    """A service of its own whose answers are checked, and those with an error counted."""

    def __init__(self, client, data_dir):
        self.client, self.data_dir, self.n_errors = client, data_dir, 0
        self._places = (data_dir.name, str(data_dir.resolve().parent), str(Path(__file__).parents[2]))

    def ask(self, method, url, body=b"", headers=None):
        answer = self.client.request(method, url, content=body, headers=headers)
        is_error = answer.status_code >= 400
        self.n_errors += is_error
        text = answer.text + json.dumps(dict(answer.headers))
        for word in (*self._places, *(INSIDE if is_error else ())):
            assert word not in text, f"{word}: {method} {url}: {text[:1000]}"
        return answer

    def walk(self, bodies=BODIES, queries=QUERIES):
        """Ask every operation, with bodies and queries good and bad, and with names that exist or not."""
        for path, by_method in self.client.get("/openapi.json").json()["paths"].items():
            for method, operation in by_method.items():
                requests = [(body, "") for body in (bodies if "requestBody" in operation else bodies[:1])]
                requests += [(bodies[0], query) for query in queries]
                for names, (body, query) in product((NAMES, dict.fromkeys(NAMES, "unknown")), requests):
                    if method != "delete" or names is not NAMES:
                        self.ask(method.upper(), f"{path.format(**names)}?{query}", *body)
            self.ask("PATCH", path.format(**NAMES))


@pytest.fixture
def listener(tmp_path):
    data_dir = tmp_path / "somewhere-secret"
    with service(data_dir) as client:
        client.make_ready_domain("ready")
        yield Listener(client, data_dir)


def test_mistakes(listener):
    listener.walk()
    for path in ("/no/such/path", "/v1", "/v1/", "/%00", "/docs/x", "/..%2f..%2fetc/passwd"):
        listener.ask("GET", path)
    assert listener.n_errors > 400
    listener.client.services.catalog.close()
    listener.client.services.session_store.close()
    shutil.rmtree(listener.data_dir)
    n_before = listener.n_errors
    listener.walk(BODIES[:1], ())
    assert listener.n_errors > n_before + 40


def damage(path):
    path.chmod(0o644)
    content = bytearray(path.read_bytes())
    for place in range(100, len(content), 97):
        content[place] ^= 0xFF
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    "harm",
    [damage, Path.unlink, lambda path: (path.unlink(), path.mkdir()), lambda path: (path.unlink(), path.touch())],
)
def test_harmed_files(listener, harm):
    session = listener.client.begin()["session_id"]
    admin = "/v1/admin/domains/ready"
    assert listener.client.post(f"{admin}/traverses", json={"name": "other"}).status_code == 201
    paths = [path for kind in ("traverses", "maps") for path in listener.data_dir.glob(f"domains/*/{kind}/*.sqlite")]
    assert len(paths) == 3
    for path in paths:
        harm(path)
    frame = json.dumps({"encoding": [0.0] * DIM}).encode()
    for method, url, body, headers in (
        ("GET", f"{admin}/traverses", b"", {}),
        ("GET", f"{admin}/traverses/drive", b"", {}),
        ("PUT", f"{admin}/traverses/other/frames/0?position_m=0", frame, JSON),
        ("POST", f"{admin}/traverses/other/frames", npz(encodings=[[0.0] * DIM], index=[0]), NPZ),
        ("PUT", f"{admin}/active-map", b'{"version": 1}', JSON),
        ("GET", f"{admin}/maps/1/file", b"", {}),
        ("GET", f"{admin}/maps", b"", {}),
        ("GET", "/v1/domains/ready", b"", {}),
        ("GET", "/readyz", b"", {}),
        ("GET", "/metrics", b"", {}),
        ("POST", f"/v1/sessions/{session}/observations", b'{"ranked_landmarks": [1]}', JSON),
        ("POST", f"{admin}/remaps", b'{"training_traverse": "drive"}', JSON),
    ):
        answer = listener.ask(method, url, body, headers)
        if answer.status_code == 202:
            job = f"/v1/admin/jobs/{listener.client.wait_for(answer.json()['job_id'])['job_id']}"
            listener.ask("GET", job)
            listener.ask("GET", f"{job}/events")
    assert listener.n_errors >= 3


# Names in paths

TRICKS = (
    *("..", "%2e%2e", "..%2f..%2f..%2f..%2fetc%2fpasswd", "%2fetc%2fpasswd", "//etc/passwd", "drive%2f..%2fdrive"),
    *("ready%2fmaps%2f000001.sqlite", "..%5c..%5cready", "%252e%252e%252fready", "%00", "drive%00", "drive%00.sqlite"),
    *("%c0%ae%c0%ae%2fready", "%ff%fe", "%ed%a0%80", "%ef%bc%8e%ef%bc%8e", "%e2%80%ae", "drive%0a", "drive%20", "%09"),
    *("~root", "-rf", ".hidden", "drive;", "drive'--", "$(id)", "{domain}", "*", "a" * 65, "a" * 5000, "%2e" * 3000),
    *("file:%2f%2f%2fetc%2fpasswd", "/dev/null", "1e3", "0x1", "99999999999999999999", "-1"),
)


async def code_of(app, method, url, body, content_type):
    """The code of the answer's problem."""
    raw, _, query = url.partition("?")
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "root_path": "",
        "path": unquote_to_bytes(raw).decode("utf-8", "replace"),
        "raw_path": raw.encode(),
        "query_string": query.encode(),
        "headers": [(b"content-type", content_type.encode()), (b"content-length", str(len(body)).encode())],
        "server": ("test", 80),
        "client": ("test", 1),
    }
    answers = []

    async def receive():
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message):
        answers.append(message)

    await app(scope, receive, send)
    if answers[0]["status"] < 400:
        return "taken"
    return json.loads(b"".join(message.get("body", b"") for message in answers))["code"]


@pytest.mark.parametrize("trick", TRICKS, ids=range(len(TRICKS)))
def test_no_name_reaches_the_file_system(client, data_dir, trick):
    """Every operation is asked with the trick in the place of each of its names in turn, the other names real."""
    sizes = {path: path.stat().st_size for path in data_dir.rglob("*")}
    requests = [
        (method, path.format(**NAMES | {name: trick}), *body)
        for method, path, *body in operations(client.app.openapi())
        for name in re.findall(r"{(\w+)}", path)
        if not is_name(unquote(trick)) or name in {"index", "version"}
    ]

    async def codes():
        return [await asyncio.wait_for(code_of(client.app, *request), 30) for request in requests]

    for request, code in zip(requests, asyncio.run(codes()), strict=True):
        assert code in {"not_found", "method_not_allowed", "invalid_request"}, (request, code)
    assert len(requests) > 1
    assert {path: path.stat().st_size for path in data_dir.rglob("*")} == sizes
