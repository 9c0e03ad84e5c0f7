"""The download of a map: every byte checked, nothing fetched twice, no half file in its place."""

import hashlib

import httpx2
import pytest

from deepsimbad_client import Client, RetryPolicy, errors

from .scripted import Script, answer
from .test_faces import run_async

BODY = bytes(range(256)) * 400
OTHER = BODY[::-1]
PATH = "/v1/admin/domains/d/maps/3/file"


def sha256(body):
    return hashlib.sha256(body).hexdigest()


class Broken(httpx2.SyncByteStream, httpx2.AsyncByteStream):
    """A stream of the beginning of a body, and then a broken link."""

    def __init__(self, body):
        self.body = body

    def __iter__(self):
        yield self.body
        raise httpx2.ReadError("the link is gone")

    async def __aiter__(self):
        yield self.body
        raise httpx2.ReadError("the link is gone")


class Shelf:
    """Serves a file as the service does; `breaks` says after how many bytes each answer breaks off.

    Attributes:
        ranges: What was asked for, "" for the whole.
    """

    def __init__(self, body=BODY, breaks=(), **headers):
        self.body, self.breaks, self.headers = body, list(breaks), headers
        self.ranges: list[str] = []
        self.slept: list[float] = []

    def __call__(self, request):
        assert request.url.path == PATH
        assert request.headers["accept-encoding"] == "identity"
        range_header = request.headers.get("range", "")
        self.ranges.append(range_header)
        etag = f'"sha256:{sha256(self.body)}"'
        headers = {"etag": etag, "content-length": str(len(self.body)), **self.headers}
        status, content = 200, self.body
        if range_header and request.headers["if-range"] == etag:
            first = int(range_header.removeprefix("bytes=").removesuffix("-"))
            if first >= len(self.body):
                return httpx2.Response(416, json={"code": "invalid_range", "detail": "beyond the end"})
            status, content = 206, self.body[first:]
            headers["content-range"] = f"bytes {first}-{len(self.body) - 1}/{len(self.body)}"
            headers["content-length"] = str(len(content))
        stop = self.breaks.pop(0) if self.breaks else None
        if stop is None:
            return httpx2.Response(status, content=content, headers=headers)
        return httpx2.Response(status, stream=Broken(content[:stop]), headers=headers)

    def fetch(self, file, attempts=3, **options):
        retry, transport = RetryPolicy(attempts=attempts), httpx2.MockTransport(self)
        with Client("http://service", retry=retry, transport=transport, sleep=self.slept.append) as client:
            return client.admin.download_map("d", 3, file, **options)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "m.sqlite"


def part_of(file, body):
    return file.with_name(f"{file.name}.{sha256(body)}.part")


def test_a_break_goes_on_where_it_was_however_often(file):
    shelf, heard = Shelf(breaks=(10_000,) * 8), []
    # Every try brings something, so it never gives up.
    fetched = shelf.fetch(file, attempts=2, on_progress=lambda *progress: heard.append(progress))
    assert (fetched.path, fetched.sha256, fetched.file_bytes) == (file, sha256(BODY), len(BODY))
    assert file.read_bytes() == BODY
    assert shelf.ranges == ["", *(f"bytes={n}0000-" for n in range(1, 9))]
    assert list(file.parent.iterdir()) == [file]
    assert heard[-1] == (len(BODY), len(BODY))


@pytest.mark.parametrize("body", [BODY, OTHER], ids=["the same", "another by now"])
def test_a_later_try_goes_on_too_or_begins_anew_where_the_file_is_another(file, body):
    shelf = Shelf(breaks=(30_000, 0, 0))
    with pytest.raises(errors.TransportError, match=r"maps/3/file"):
        shelf.fetch(file, attempts=2)
    assert not file.exists()
    shelf.body = body
    shelf.fetch(file)
    assert "bytes=30000-" in shelf.ranges
    assert file.read_bytes() == body
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("n_there", [len(BODY), len(BODY) + 5])
def test_a_part_without_a_rest_is_fetched_anew(file, n_there):
    part_of(file, BODY).write_bytes((BODY + b"12345")[:n_there])
    shelf = Shelf()
    shelf.fetch(file)
    assert shelf.ranges == [f"bytes={n_there}-", ""]
    assert file.read_bytes() == BODY


def test_a_part_that_was_spoilt_is_found_out_and_dropped(file):
    part_of(file, BODY).write_bytes(b"x" * 100)
    with pytest.raises(errors.DamagedDownloadError, match=sha256(BODY)):
        Shelf().fetch(file)
    assert list(file.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("etag", "error"),
    [(f'"sha256:{sha256(OTHER)}"', errors.DamagedDownloadError), ('W/"1"', errors.UnexpectedAnswerError)],
)
def test_a_file_of_another_digest_or_none_never_replaces_a_good_one(file, etag, error):
    file.write_bytes(b"good")
    with pytest.raises(error):
        Shelf(etag=etag).fetch(file)
    assert file.read_bytes() == b"good"


def test_refusals_have_their_names_and_are_waited_out_where_they_pass(file):
    retired = {"code": "retired_map", "detail": "map 3 was removed"}
    script = Script(answer(503, {"code": "overloaded"}, retry_after="7"), answer(410, retired))
    with pytest.raises(errors.RetiredMapError, match="was removed"):
        script.client().admin.download_map("d", 3, file)
    assert script.slept == [7.0]


def test_a_place_where_no_file_can_lie_is_refused_before_anything_is_asked(file):
    shelf = Shelf()
    for path in (file.parent, file.parent / "nowhere" / "m"):
        with pytest.raises(errors.InvalidArgumentError):
            shelf.fetch(path)
    assert shelf.ranges == []
    with pytest.raises(errors.NotSavedError, match="name too long"):
        shelf.fetch(file.parent / ("m" * 250))


def test_the_async_client_fetches_the_same(file):
    shelf = Shelf(breaks=(10_000, 20_000))

    async def fetch(client):
        assert (await client.admin.download_map("d", 3, str(file))).sha256 == sha256(BODY)

    assert len(run_async(shelf, fetch)) == 2
    assert file.read_bytes() == BODY
    assert shelf.ranges == ["", "bytes=10000-", "bytes=30000-"]
