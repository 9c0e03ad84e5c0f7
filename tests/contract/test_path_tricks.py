"""No name in a path reaches the file system: every operation refuses it before it looks, and what is opened is watched.

The names go through the application as a server hands them on: percent-encoding undone.
"""

import asyncio
import json
import os
import re
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import pytest
from starlette.testclient import TestClient
from starlette.types import Message, Scope

from deepsimbad.store.layout import is_name

REAL = {"domain": "ready", "name": "drive", "index": "0", "version": "1", "session_id": "none", "job_id": "none"}
TRICKS = (
    "..",
    "%2e%2e",
    "..%2f..%2f..%2f..%2fetc%2fpasswd",
    "%2fetc%2fpasswd",
    "//etc/passwd",
    "drive%2f..%2fdrive",
    "ready%2fmaps%2f000001.sqlite",
    "..%5c..%5cready",
    "%252e%252e%252fready",
    "%00",
    "drive%00",
    "drive%00.sqlite",
    "%c0%ae%c0%ae%2fready",
    "%ff%fe",
    "%ed%a0%80",
    "%ef%bc%8e%ef%bc%8e",
    "%e2%80%ae",
    "drive%0a",
    "drive%20",
    "%09",
    "~root",
    "-rf",
    ".hidden",
    "drive;",
    "drive'--",
    "$(id)",
    "{domain}",
    "*",
    "a" * 65,
    "a" * 5000,
    "%2e" * 3000,
    "file:%2f%2f%2fetc%2fpasswd",
    "/dev/null",
    "1e3",
    "0x1",
    "99999999999999999999",
    "-1",
)
_TOUCHING = {"open", "sqlite3.connect", "os.listdir", "os.scandir", "os.mkdir", "os.remove", "os.rmdir", "os.rename"}


class Watch:
    """What the process opens, lists, makes or removes while it is on. A hook stays for good, so there is one."""

    def __init__(self) -> None:
        self.touched: list[str] | None = None
        sys.addaudithook(self._heard)

    def _heard(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.touched is not None and event in _TOUCHING:
            for each in arguments[:2] if event == "os.rename" else arguments[:1]:
                if isinstance(each, (str, bytes, os.PathLike)):
                    self.touched.append(os.fsdecode(each))


@pytest.fixture(scope="module")
def watch() -> Watch:
    return Watch()


def requests(document: dict[str, Any], trick: str) -> Iterator[tuple[str, str, bytes, list[tuple[bytes, bytes]]]]:
    """Every operation with the trick as each of its names in turn, the others real, and a body that would be taken."""
    for path, by_method in document["paths"].items():
        for method, operation in by_method.items():
            required = [each for each in operation.get("parameters", ()) if each["in"] == "query" and each["required"]]
            query = "&".join(f"{each['name']}={each['example']}" for each in required)
            body, headers = body_of(operation, document["components"]["schemas"])
            for tricked in re.findall(r"{(\w+)}", path):
                if not is_name(unquote(trick)) or tricked in {"index", "version"}:
                    yield method.upper(), f"{path.format(**{**REAL, tricked: trick})}?{query}", body, headers


def body_of(operation: dict[str, Any], schemas: dict[str, Any]) -> tuple[bytes, list[tuple[bytes, bytes]]]:
    if "requestBody" not in operation:
        return b"", []
    content = operation["requestBody"]["content"]
    if "application/json" not in content:
        return b"an archive", [(b"content-type", next(iter(content)).encode())]
    schema = content["application/json"]["schema"]
    example: Any = {"encoding": [1.0] * 8}
    if "$ref" in schema:
        (example,) = schemas[schema["$ref"].rpartition("/")[2]]["examples"]
    return json.dumps(example).encode(), [(b"content-type", b"application/json")]


def ask(app: Any, method: str, url: str, body: bytes, headers: list[tuple[bytes, bytes]]) -> str:
    """The code of the answer's problem."""
    raw, _, query = url.partition("?")
    scope: Scope = {
        "type": "http",
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": unquote_to_bytes(raw).decode("utf-8", "replace"),
        "raw_path": raw.encode(),
        "query_string": query.encode(),
        "root_path": "",
        "headers": [*headers, (b"content-length", str(len(body)).encode())],
        "server": ("test", 80),
        "client": ("test", 1),
    }
    sent: list[Message] = []
    is_asked = False

    async def receive() -> Message:
        nonlocal is_asked
        if is_asked:
            await asyncio.sleep(3600)
        is_asked = True
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Message) -> None:
        sent.append(message)

    async def answered() -> None:
        await app(scope, receive, send)

    asyncio.run(asyncio.wait_for(answered(), 30))
    if sent[0]["status"] < 400:
        return "taken"
    code: str = json.loads(b"".join(each.get("body", b"") for each in sent))["code"]
    return code


@pytest.mark.parametrize("trick", TRICKS, ids=range(len(TRICKS)))
def test_no_name_reaches_the_file_system(client: TestClient, data_dir: Path, watch: Watch, trick: str) -> None:
    document = client.get("/openapi.json").json()
    before = {path: path.stat().st_size for path in data_dir.rglob("*.sqlite")}
    of_python = [Path(path).resolve() for path in (*sysconfig.get_paths().values(), sys.prefix, sys.base_prefix)]
    of_python.append(Path(__file__).resolve().parents[2] / "service")
    n_asked = 0
    watch.touched = []
    try:
        for method, url, body, headers in requests(document, trick):
            n_asked += 1
            code = ask(client.app, method, url, body, headers)
            assert code in {"not_found", "method_not_allowed", "invalid_request"}, (method, url, code)
    finally:
        touched, watch.touched = watch.touched, None
    assert n_asked > 1
    known = {str(path) for path in data_dir.rglob("*")} | {str(data_dir)}
    for path in {re.sub(r"^file:|\?.*$", "", path) for path in touched}:
        if not any(folder in Path(path).resolve().parents for folder in of_python):
            assert path in known or path.removesuffix("-journal") in known, path
    assert {path: path.stat().st_size for path in data_dir.rglob("*.sqlite")} == before
    assert client.get("/v1/domains/ready").json()["map_version"] == 1
