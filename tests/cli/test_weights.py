"""`deepsimbad weights`, against a small server of files on this machine."""

import contextlib
import hashlib
import io
import json
import re
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import torch

from deepsimbad.evaluators.weights import downloads

COMMIT = "0123456789abcdef0123456789abcdef01234567"
NEWER = "f" * 40
CONTENT = bytes(range(256)) * 9000
SHA256 = hashlib.sha256(CONTENT).hexdigest()

HUBCONF = """
import torch

def places(dim=6):
    model = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, dim))
    model.load_state_dict(torch.hub.load_state_dict_from_url("{url}/checkpoint-{digest}.pth", check_hash=True))
    return model
"""


@dataclass
class Files:
    """What is served, how, and what was asked for."""

    content: dict[str, bytes] = field(default_factory=dict)  # by path
    url: str = ""
    tear: dict[str, list[int]] = field(default_factory=dict)  # a path's next answers break off after so many bytes
    status: dict[str, int] = field(default_factory=dict)  # a path is answered with this status alone
    headers: dict[str, str] = field(default_factory=dict)  # of every answer
    requests: list[tuple[str, str | None]] = field(default_factory=list)  # path and Range of every request
    has_etag: bool = True


@pytest.fixture
def files() -> Iterator[Files]:
    new_files = Files()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_):
            pass

        def refuse(self, status, *headers):
            self.send_response(status)
            for header in (*headers, ("Content-Length", "0")):
                self.send_header(*header)
            self.end_headers()

        def do_GET(self):
            byte_range = self.headers["Range"]
            new_files.requests.append((self.path, byte_range))
            content = new_files.content.get(self.path)
            status = new_files.status.get(self.path, 200 if content is not None else 404)
            if status != 200:
                self.refuse(status)
                return
            etag, first = f'"{hashlib.sha256(content).hexdigest()}"', 0
            if byte_range and self.headers["If-Range"] in {None, etag}:
                first = int(byte_range.removeprefix("bytes=").removesuffix("-"))
                if first >= len(content):
                    self.refuse(416, ("Content-Range", f"bytes */{len(content)}"))
                    return
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {first}-{len(content) - 1}/{len(content)}")
            else:
                self.send_response(200)
            for name, value in (*new_files.headers.items(), ("Content-Length", len(content) - first)):
                self.send_header(name, str(value))
            if new_files.has_etag:
                self.send_header("ETag", etag)
            self.end_headers()
            torn = new_files.tear.get(self.path)
            with contextlib.suppress(OSError):  # who asked may have heard enough
                self.wfile.write(content[first : first + torn.pop(0)] if torn else content[first:])
            self.close_connection = True

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    new_files.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield new_files
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def repository(files, monkeypatch) -> Files:
    """someone/Places, as GitHub would give it, and the checkpoint that it downloads."""
    stream = io.BytesIO()
    torch.manual_seed(0)
    torch.save({f"2.{name}": array for name, array in torch.nn.Linear(3, 6).state_dict().items()}, stream)
    digest = hashlib.sha256(stream.getvalue()).hexdigest()[:8]
    files.content[f"/checkpoint-{digest}.pth"] = stream.getvalue()
    for commit in (COMMIT, NEWER):
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as zip_file:
            text = HUBCONF.replace("{url}", files.url).replace("{digest}", digest)
            zip_file.writestr(f"Places-{commit}/hubconf.py", text + f"# {commit}")
        files.content[f"/someone/Places/archive/{commit}.zip"] = archive.getvalue()
    files.content["/repos/someone/Places/commits/HEAD"] = COMMIT.encode()
    monkeypatch.setattr(downloads, "GITHUB", files.url)
    monkeypatch.setattr(downloads, "GITHUB_API", files.url)
    return files


HUB = "torchhub:someone/Places:places"
IN = ("--weights-dir", "w")


@pytest.fixture
def pull(deepsimbad, files):
    """Pulls m.onnx from the server."""
    files.content["/m.onnx"] = CONTENT
    return lambda *options: deepsimbad("weights", "pull", "onnx:m.onnx", "--url", f"{files.url}/m.onnx", *options, *IN)


@pytest.fixture
def list_rows(deepsimbad):
    """The rows of `weights list`."""
    return lambda: json.loads(deepsimbad("weights", "list", "--json", *IN).out)


@pytest.fixture
def folder(tmp_path):
    """Where weights lie."""
    return tmp_path / "w"


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_known_ones_are_listed(deepsimbad, list_rows, folder):
    ran = deepsimbad("weights", "list", *IN)
    assert (ran.code, ran.err) == (0, "")
    for word in ("torchhub:gmberton/MegaLoc:get_trained_model", "8448", "322x322", "GPL-3.0", "529 MB", "netvlad:"):
        assert word in ran.out
    assert not folder.exists()
    rows = {row["name"]: row for row in list_rows()}
    expected = {"extractor": "torchhub:amaralibey/Bag-of-Queries:get_trained_boq", "packages": ["torchvision"]}
    expected |= {"state": "-"}
    assert {name: rows["boq"][name] for name in expected} == expected
    assert rows["efficientnet-lite0"]["state"] == "with its package"


def test_what_was_pulled_or_put_there_is_listed(pull, deepsimbad, folder, list_rows):
    folder.mkdir()
    (folder / "vgg16_netvlad.pth").write_bytes(b"x")
    assert pull().code == 0
    rows = {row["extractor"]: row for row in list_rows()}
    assert rows["netvlad:vgg16_netvlad.pth"]["state"] == "not recorded"
    assert (rows["onnx:m.onnx"]["state"], rows["onnx:m.onnx"]["size_mb"]) == ("pulled", 2.3)
    (folder / "m.onnx").unlink()
    assert {row["extractor"]: row for row in list_rows()}["onnx:m.onnx"]["state"] == "missing"
    assert "onnx:m.onnx" in deepsimbad("weights", "list", *IN).out


def test_a_file_is_pulled_recorded_and_verified(pull, deepsimbad, files, folder):
    ran = pull("--json")
    assert (ran.code, ran.err) == (0, f"onnx:m.onnx is at w/m.onnx, sha256 {SHA256}\n")
    assert json.loads(ran.out) == [{"extractor": "onnx:m.onnx", "path": "w/m.onnx", "sha256": SHA256}]
    assert names_in(folder) == ["m.onnx", "weights.lock"]
    ran = deepsimbad("weights", "verify", *IN)
    assert (ran.code, ran.out) == (0, f"good: w/m.onnx: {SHA256}\n")
    assert deepsimbad("weights", "pull", "onnx:m.onnx", *IN).code == 0, "it is here"
    assert len(files.requests) == 1
    (folder / "m.onnx").write_bytes(b"changed")
    ran = deepsimbad("weights", "verify", "onnx:m.onnx", *IN)
    assert (ran.code, ran.out.startswith("differs: w/m.onnx: "), SHA256 in ran.out) == (1, True, True)
    (folder / "m.onnx").unlink()
    ran = deepsimbad("weights", "verify", "--json", *IN)
    finding = {"path": "w/m.onnx", "recorded": SHA256, "found": None}
    assert (ran.code, json.loads(ran.out)["findings"]) == (1, [finding])
    files.content["/m.onnx"] = CONTENT[:-1]
    line = deepsimbad("weights", "pull", "onnx:m.onnx", *IN).line
    assert re.search(f"should have {SHA256}.*or say --sha256", line), "it is held to what came first"
    assert not (folder / "m.onnx").exists()


def test_a_download_that_breaks_off_goes_on(pull, files):
    files.tear["/m.onnx"] = [1000, 500_000]
    ran = pull("--sha256", SHA256[:8])
    assert ran.code == 0, ran.err
    assert [byte_range for _, byte_range in files.requests] == [None, "bytes=1000-", "bytes=501000-"]


@pytest.fixture
def broken_off(pull, files, folder):
    """Leaves a part of the file, and a try in which nothing came."""

    def leave(*options):
        files.tear["/m.onnx"] = [1000, 0, 0, 0, 0]
        assert re.search("missing_weights.*broke off", pull(*options).line)
        assert {"m.onnx", "m.onnx.part"} & set(names_in(folder)) == {"m.onnx.part"}
        files.tear.clear()
        files.requests.clear()

    return leave


@pytest.mark.parametrize(
    ("has_etag", "options", "byte_range"),
    [(True, (), "bytes=1000-"), (False, (), None), (False, ("--sha256", SHA256), "bytes=1000-")],
)
def test_a_later_pull_goes_on_where_the_file_is_the_same(
    pull, broken_off, files, folder, has_etag, options, byte_range
):
    """As the server's tag says, or the digest that is asked for."""
    files.has_etag = has_etag
    broken_off(*options)
    ran = pull(*options)
    assert ran.code == 0, ran.err
    assert (folder / "m.onnx").read_bytes() == CONTENT
    assert files.requests == [("/m.onnx", byte_range)]
    assert names_in(folder) == ["m.onnx", "weights.lock"]


@pytest.mark.parametrize("new_content", [CONTENT[::-1], CONTENT[:10], CONTENT[:1000]])
def test_a_file_that_has_changed_meanwhile_comes_anew(pull, broken_off, files, folder, new_content):
    broken_off()
    files.content["/m.onnx"] = new_content
    assert pull().code == 0
    assert (folder / "m.onnx").read_bytes() == new_content


def test_a_part_that_is_the_whole_file_or_longer(pull, files, folder):
    """The server says "beyond the end": either nothing is missing, or it is no part of this file."""
    files.has_etag = False
    folder.mkdir()
    for part_content in (CONTENT, CONTENT + b"x"):
        (folder / "m.onnx").unlink(missing_ok=True)
        (folder / "m.onnx.part").write_bytes(part_content)
        assert pull("--sha256", SHA256).code == 0
        assert (folder / "m.onnx").read_bytes() == CONTENT
    n = len(CONTENT)
    assert [byte_range for _, byte_range in files.requests] == [f"bytes={n}-", f"bytes={n + 1}-", None]


@pytest.mark.parametrize(
    ("status", "headers", "most_bytes", "message"),
    [
        (404, {}, None, "answered 404.*put it at w/m.onnx"),
        (503, {}, None, "answered 503.*put it at w/m.onnx"),
        (200, {"Content-Type": "text/html"}, None, "answered a page.*put it at w/m.onnx"),
        (200, {}, len(CONTENT) - 1, "larger than any file of weights"),
    ],
)
def test_what_is_no_file_is_not_kept(pull, files, folder, monkeypatch, status, headers, most_bytes, message):
    files.status["/m.onnx"], files.headers = status, headers
    if most_bytes:
        monkeypatch.setattr(downloads, "_MOST_BYTES", most_bytes)
    assert re.search(message, pull().line)
    assert names_in(folder) == []


@pytest.mark.parametrize("url", ["http://127.0.0.1:9/m.onnx", "ftp://a/m.onnx", "no address"])
def test_without_a_network_it_says_which_file_to_put_where(deepsimbad, folder, url):
    line = deepsimbad("weights", "pull", "onnx:m.onnx", "--url", url, *IN).line
    assert line.startswith(f"deepsimbad: missing_weights: {url} cannot be reached")
    assert "put it at w/m.onnx and pull again" in line
    (folder / "m.onnx").write_bytes(CONTENT)
    assert "invalid_weights: m.onnx is no whole" in deepsimbad("weights", "pull", "onnx:m.onnx", *IN).line
    ran = deepsimbad("weights", "pull", "onnx:m.onnx", "--sha256", SHA256[:8], *IN)
    assert (ran.code, ran.err) == (0, f"onnx:m.onnx is at w/m.onnx, sha256 {SHA256}\n")


@pytest.fixture
def pull_hub(deepsimbad):
    """Pulls the repository, whose code is trusted."""
    return lambda *options: deepsimbad("weights", "pull", HUB, "--yes", *options, *IN)


def test_a_repository_is_pulled_at_a_commit_and_held_to_it(pull_hub, deepsimbad, repository, folder, list_rows):
    def record():
        (hub_record,) = json.loads((folder / "weights.lock").read_text())["hub"].values()
        return hub_record

    ran = pull_hub("--input-size", "28x28", "--json")
    assert ran.code == 0, ran.err
    assert f"{HUB} runs the code of github.com/someone/Places on this machine" in ran.err
    assert [pulled["path"] for pulled in json.loads(ran.out)] == [f"w/hub/someone_Places_{COMMIT}"]
    first = record()
    assert (first["commit"], first["encoding_dim"], first["input_size"]) == (COMMIT, 6, [28, 28])
    assert [f"checkpoints/{name}" for name in names_in(folder / "hub" / "checkpoints")] == list(first["beside"])
    assert not list((folder / "hub").glob("*.zip"))
    ran = deepsimbad("weights", "verify", HUB, *IN)
    assert (ran.code, ran.out.count("good: ")) == (0, 2)
    repository.content["/repos/someone/Places/commits/HEAD"] = NEWER.encode()
    n_requests = len(repository.requests)
    assert pull_hub().code == 0
    assert len(repository.requests) == n_requests, "what is here as recorded is not fetched again"
    assert json.loads((folder / "weights.lock").read_text())["hub"] == {HUB.lower(): first}
    assert pull_hub("--commit", NEWER, "--argument", "dim=6").code == 0
    assert (record()["commit"], record()["arguments"]) == (NEWER, {"dim": 6})
    assert not (folder / "hub" / f"someone_Places_{COMMIT}").exists()
    (row,) = [row for row in list_rows() if row["state"] == "pulled"]
    assert (row["name"], row["encoding_dim"], row["input"]) == ("someone/Places", 6, "28x28")
    (folder / "hub" / f"someone_Places_{NEWER}" / "hubconf.py").write_text("changed")
    ran = deepsimbad("weights", "verify", *IN)
    assert (ran.code, f"differs: w/hub/someone_Places_{NEWER}" in ran.out) == (1, True)


def test_a_checkpoint_of_another_digest_than_the_repositorys_is_refused(pull_hub, repository, folder):
    (path,) = (path for path in repository.content if path.startswith("/checkpoint"))
    repository.content[path] += b"x"
    ran = pull_hub("--input-size", "28x28")
    assert (ran.code, "invalid_weights" in ran.err) == (1, True)
    assert not (folder / "weights.lock").exists()


def test_nobodys_code_is_run_unasked(deepsimbad, repository, folder):
    ran = deepsimbad("weights", "pull", HUB, *IN)
    assert (ran.code, ran.out, "say --yes if you trust it" in ran.err) == (2, "", True)
    assert (repository.requests, folder.exists()) == ([], False)


@pytest.mark.parametrize(("answer", "code"), [("y", 0), ("n", 130)])
def test_a_person_is_asked(deepsimbad, repository, monkeypatch, answer, code):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("click.termui.visible_prompt_func", lambda _: answer)
    ran = deepsimbad("weights", "pull", HUB, "--input-size", "28x28", *IN)
    assert ran.code == code
    assert "runs the code of github.com/someone/Places" in ran.err
    assert bool(repository.requests) == (code == 0)


def test_a_repository_without_a_network(pull_hub, monkeypatch, folder):
    for host in ("GITHUB", "GITHUB_API"):
        monkeypatch.setattr(downloads, host, "http://127.0.0.1:9")
    for options, says in (
        ((), "--commit"),
        (
            ("--commit", COMMIT),
            f"http://127.0.0.1:9/someone/Places/archive/{COMMIT}.zip cannot be reached.*"
            f"put it at {folder}/hub/someone_Places_{COMMIT}.zip and pull again",
        ),
    ):
        ran = pull_hub(*options)
        assert ran.code == 1
        assert re.search(says, ran.err.splitlines()[-1])


@pytest.mark.parametrize(
    "arguments",
    [
        "pull",
        "pull onnx:a.onnx onnx:b.onnx --url http://a",
        f"pull onnx:a.onnx --commit {COMMIT}",
        "pull onnx:a.onnx --sha256 123",
        *(f"pull {HUB} --yes {options}" for options in ("--commit main", "--url http://a")),
        *(f"pull {HUB} --yes {options}" for options in ("--argument =3", "--input-size 28")),
    ],
)
def test_usage(deepsimbad, folder, arguments):
    assert deepsimbad("weights", *arguments.split(), *IN).code == 2
    assert not folder.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("pull nothing", "is no name of"),
        ("pull onnx:../a.onnx", "is no name of"),
        ("pull torchhub:someone:entry", "is no name of"),
        ("pull gradient_grid", "is no name of"),
        ("pull efficientnet-lite0", "comes with the package"),
        ("pull onnx:a.onnx", "say where it is with --url"),
        ("pull pytorch-netvlad", "put it at w/checkpoint.pth.tar"),
        ("verify megaloc", "was never pulled to w"),
    ],
)
def test_mistakes_are_named(deepsimbad, arguments, message):
    assert message in deepsimbad("weights", *arguments.split(), *IN).line


def test_nothing_pulled_is_nothing_to_verify(deepsimbad, monkeypatch, tmp_path):
    monkeypatch.setenv("DEEPSIMBAD_WEIGHTS_DIR", "elsewhere")
    assert deepsimbad("weights", "verify").out == ""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "weights.lock").write_text("{")
    assert "elsewhere/weights.lock is no lock of weights" in deepsimbad("weights", "verify").err
