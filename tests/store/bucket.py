"""An S3 server on this machine, whose buckets are folders, and what a node needs in its environment to reach it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from localbucket import S3Error, S3Handler

BUCKET, KEY_ID = "fleet-maps", "robot"


@dataclass(frozen=True)
class Bucket:
    folder: Path
    url: str
    environment: dict[str, str]
    requests: list[str]


@contextmanager
def served_bucket(root: Path) -> Iterator[Bucket]:
    requests: list[str] = []

    class Handler(S3Handler):
        data_root = root

        def log_message(self, *args: Any) -> None:
            pass

        def _dispatch(self, action: Any) -> None:
            requests.append(f"{self.command} {self.path}")
            if f"Credential={KEY_ID}/" in self.headers.get("Authorization", ""):
                super()._dispatch(action)
            else:
                self._read_body()
                self._send_error(S3Error(HTTPStatus.FORBIDDEN, "AccessDenied", "Access Denied"))

        def _post_request(self, bucket: str, key: str) -> None:
            if key or "delete" not in self.query:
                super()._post_request(bucket, key)
                return
            deletions = ElementTree.Element("DeleteResult")
            for element in ElementTree.fromstring(self._read_body()).findall(".//{*}Key"):
                self._object_path(bucket, str(element.text)).unlink(missing_ok=True)
                ElementTree.SubElement(ElementTree.SubElement(deletions, "Deleted"), "Key").text = element.text
            self._send_xml(deletions)

    folder = root / BUCKET
    folder.mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        environment = {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
            "AWS_ACCESS_KEY_ID": KEY_ID,
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_REGION": "us-east-1",
        }
        yield Bucket(folder, f"s3://{BUCKET}/maps-of/fleet", environment, requests)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
