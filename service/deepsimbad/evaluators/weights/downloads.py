"""Downloads of weights' files and repositories' archives: resumed after a break, checked, whole or not there."""

import hashlib
import os
import re
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import httpx2

from deepsimbad.errors import InvalidWeightsError, MissingPackageError, MissingWeightsError
from deepsimbad.evaluators.compute import Compute, Device, Runtime
from deepsimbad.evaluators.registry import make_extractor
from deepsimbad.evaluators.weights.files import file_sha256
from deepsimbad.evaluators.weights.library import HUB, KNOWN, Argument, known_weights
from deepsimbad.evaluators.weights.lock import (
    CHECKPOINTS,
    HUB_FOLDER,
    FileRecord,
    Finding,
    HubRecord,
    Lock,
    found_sha256,
    hub_tree,
    tree_sha256,
)

GITHUB = "https://github.com"
GITHUB_API = "https://api.github.com"

Tell = Callable[[str, int, int | None], None]
"""Takes a download's progress: the file's name, the bytes received, the bytes in all (None: not known)."""

HUB_INPUT_SIZE = (322, 322)  # pixels; a multiple of the 14 that DINOv2 asks for
_MOST_BYTES = 4 << 30
_MOST_UNPACKED = 512 << 20  # of a repository
_MOST_MEMBERS = 20_000
_MOST_RATIO = 100  # source texts reach ten
_TRIES = 4  # in a row without a single byte; a download that moves is never given up
_WHOLE, _PART, _BEYOND_THE_END = 200, 206, 416
_PATIENCE = httpx2.Timeout(connect=10.0, read=60.0, write=60.0, pool=60.0)
_CONTENT_RANGE = re.compile(r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)")
_COMMIT = re.compile(r"[0-9a-f]{40}")


def pull_file(
    folder: Path, extractor: str, tell: Tell, url: str | None = None, sha256: str | None = None
) -> FileRecord:
    """Bring a file of weights into the folder and record it; one that lies there already is only recorded.

    Args:
        extractor: NAME:FILE, which names the file.
        url: Where it is; None: where the library knows it to be.
        sha256: Its digest, in hex; None: the recorded one, else the library's, else that of what comes the first time.

    Raises:
        MissingWeightsError: It cannot be fetched; the message says where to put it.
        InvalidWeightsError: It has another digest, or one that nobody stated cannot be loaded.
        OutOfMemoryError: There is too little memory to load it.
    """
    name = extractor.partition(":")[2]
    lock, target = Lock.read(folder), folder / name
    weights = next((weights for weights in KNOWN if weights.file == name), None)
    old_record = lock.files.get(name)
    expected_sha256 = sha256 or (old_record.sha256 if old_record else None) or (weights.sha256 if weights else None)
    source_url = old_record.url if old_record else None
    advice = ", or say --sha256 with the digest of the right file" if old_record and not sha256 else ""
    if target.is_file():
        digest = found_sha256(target) or ""
        check_digest(name, digest, expected_sha256, f"remove {target}, and pull it again{advice}")
        if expected_sha256 is None:  # nobody vouches for it: what is no whole file would be held to for ever
            with suppress(MissingPackageError):
                make_extractor(extractor, Compute(Runtime.TORCH, Device.CPU, weights_dir=folder))
    else:
        source_url = url or source_url or (weights.url if weights else None)
        if source_url is None:
            page = weights.page if weights else None
            source = f"get it from {page} and " if page else "say where it is with --url, or "
            raise MissingWeightsError(
                f"{name} is not known to be at any address: {source}put it at {target}", file=name
            )
        digest = fetch(source_url, target, tell, expected_sha256, advice)
    record = FileRecord(digest, target.stat().st_size, extractor, source_url)
    lock.with_file(name, record).write()
    return record


@dataclass(frozen=True)
class HubWish:
    """What to pull of a torch hub repository; None is the recorded value, else the library's, else a default."""

    extractor: str  # torchhub:OWNER/REPO:ENTRY
    commit: str | None = None  # of the repository; by default the one its default branch is at now
    sha256: str | None = None  # of the repository's archive; by default any
    # of the entry, added to those that the library knows
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    input_size: tuple[int, int] | None = None  # (width, height) in pixels; by default `HUB_INPUT_SIZE`


def pull_hub(folder: Path, wish: HubWish, tell: Tell) -> HubRecord:
    """Bring a repository here, run its entry once so that its own downloads come too, and record all of it.

    Raises:
        MissingWeightsError: Something cannot be fetched; the message says where to put it.
        InvalidWeightsError: It is another than was recorded, or gives no encodings.
        MissingPackageError: Its code needs a package that is not installed.
    """
    from deepsimbad.evaluators.extractors.torchhub import HubEntry, load_recorded, parameters_sha256  # brings torch

    lock, weights = Lock.read(folder), known_weights(wish.extractor)
    old_record = lock.hub_record(wish.extractor)
    repository = (weights.extractor if weights else wish.extractor).removeprefix(HUB).partition(":")[0]
    defaults = old_record or weights
    arguments = {**(defaults.arguments if defaults else {}), **wish.arguments}
    size = wish.input_size or (defaults.input_size if defaults else None) or HUB_INPUT_SIZE
    commit = wish.commit or (defaults.commit if defaults else None)
    if commit is None:
        commit = resolve_commit(repository, f"say which one you want with --commit; see {archive_url(repository, '')}")
    hub = folder.absolute() / HUB_FOLDER
    tree, archive = hub / hub_tree(repository, commit), hub / f"{hub_tree(repository, commit)}.zip"
    unpacked = next((record for record in lock.hub.values() if record.folder == tree.name), None)
    if unpacked is not None and found_sha256(tree) == unpacked.tree_sha256:  # perhaps for another of its entries
        archive_sha256 = unpacked.archive_sha256
    else:
        if not archive.is_file():
            fetch(archive_url(repository, commit), archive, tell, wish.sha256)
        archive_sha256 = file_sha256(archive)
        unpack(archive, tree)
    check_digest(archive.name, archive_sha256, wish.sha256, f"remove {archive}, and pull again")
    is_again = old_record is not None and (old_record.commit, dict(old_record.arguments)) == (commit, arguments)
    if old_record is not None and is_again:
        Finding(tree, old_record.tree_sha256, found_sha256(tree)).check()  # before any of it is run

    def download(url: str, target: Path) -> None:
        fetch(
            url,
            target,
            tell,
            old_record.beside.get(f"{CHECKPOINTS}/{target.name}") if old_record and is_again else None,
        )

    dim = weights.encoding_dim if weights is not None and arguments == dict(weights.arguments) else None
    loaded = HubEntry(wish.extractor, hub, tree, arguments, size, dim).load(download)
    companions = {name: found_sha256(hub / name) or "" for name in loaded.companions}
    record = HubRecord(
        repository, commit, archive_sha256, tree_sha256(tree), arguments, size, loaded.encoding_dim,
        parameters_sha256(loaded.trunk), companions,
    )  # fmt: skip
    if old_record is not None and is_again:
        for name in {**old_record.beside, **companions}:
            new_sha256, old_sha256 = companions.get(name, "none"), old_record.beside.get(name, "none")
            check_digest(f"{HUB_FOLDER}/{name}", new_sha256, old_sha256, "remove it, and pull again")
        check_digest(
            f"{wish.extractor}'s parameters", record.parameters_sha256, old_record.parameters_sha256, "they changed"
        )
    lock = lock.with_hub(wish.extractor, record)
    load_recorded(lock, wish.extractor, record)  # as every later load: from here alone
    lock.write()
    archive.unlink(missing_ok=True)
    if old_record is not None and old_record.folder not in {entry.folder for entry in lock.hub.values()}:
        shutil.rmtree(hub / old_record.folder, ignore_errors=True)
    return record


def fetch(url: str, target: Path, tell: Tell, sha256: str | None = None, advice: str = "") -> str:
    """Download a file.

    The part received waits in `NAME.part`, and the version of the file it belongs to in `NAME.part.etag`, so that a
    later try goes on where this one stopped.

    Args:
        target: Path of the file; one that lies there is replaced.
        sha256: Its digest in hex, or the first digits of it; None: not known.
        advice: What can be done where it has another, to end the error's message.

    Returns:
        Its SHA-256, in hex.

    Raises:
        MissingWeightsError: It cannot be fetched; the message says where to put it.
        InvalidWeightsError: It has another digest, or is larger than any file of weights.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    return _Download(url, target, tell, sha256, advice).run()


def resolve_commit(repository: str, advice: str) -> str:
    """The commit that a repository's default branch is at now; raises MissingWeightsError."""
    url = f"{GITHUB_API}/repos/{repository}/commits/HEAD"
    try:
        answer = httpx2.get(
            url, headers={"Accept": "application/vnd.github.sha"}, timeout=_PATIENCE, follow_redirects=True
        )
    except httpx2.TransportError as error:
        raise _missing(url, f"cannot be reached ({_reason(error)})", advice) from error
    if answer.status_code != _WHOLE or _COMMIT.fullmatch(answer.text.strip()) is None:
        raise _missing(url, f"answered {answer.status_code}, and no commit", advice)
    return answer.text.strip()


def archive_url(repository: str, commit: str) -> str:
    """Where GitHub gives a repository's tree at a commit."""
    return f"{GITHUB}/{repository}/archive/{commit}.zip"


def unpack(archive: Path, target: Path) -> None:
    """Unpack a repository's archive: its one folder becomes the folder `target`, and replaces one that was there.

    Raises:
        InvalidWeightsError: It is no such archive, would write outside, or unpacks to more than a repository holds.
    """
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".unpacking-") as folder:
        try:
            with zipfile.ZipFile(archive) as zip_file:
                root = _root(zip_file, archive)
                zip_file.extractall(folder)
        except (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
            raise InvalidWeightsError(f"{archive.name} is no whole archive", file=archive.name) from error
        if not (Path(folder) / root / "hubconf.py").is_file():
            raise InvalidWeightsError(
                f"{archive.name} has no hubconf.py: it is no torch hub repository", file=archive.name
            )
        shutil.rmtree(target, ignore_errors=True)
        (Path(folder) / root).replace(target)


def matches(sha256: str, expected: str | None) -> bool:
    """Whether a digest is the expected one, of which perhaps only the first digits are known; None: any is."""
    return expected is None or sha256.startswith(expected.lower())


def check_digest(name: str, sha256: str, expected: str | None, remedy: str) -> None:
    """Refuse another digest than the expected one; raises InvalidWeightsError, whose message ends with the remedy."""
    if not matches(sha256, expected):
        raise InvalidWeightsError(
            f"{name} has sha256 {sha256} and should have {expected}: {remedy}", file=name, found=sha256, wanted=expected
        )


class _Download:
    """The download of one file."""

    def __init__(self, url: str, target: Path, tell: Tell, sha256: str | None, advice: str) -> None:
        self._url, self._to, self._tell, self._sha256 = url, target, tell, sha256
        self._digest_advice = advice
        self._advice = f"fetch it where there is a network, put it at {target} and pull again"
        self._part = target.with_name(f"{target.name}.part")
        self._version = target.with_name(f"{target.name}.part.etag")
        self._n_received = 0

    def run(self) -> str:
        """Request the file until all of it has come; gives up only where nothing comes several times in a row."""
        tries = 0
        with httpx2.Client(follow_redirects=True, timeout=_PATIENCE) as http:
            while True:
                n_before, reason = self._n_received, ""
                try:
                    reason = self._receive(http)
                    if not reason:
                        return self._finish()
                except (httpx2.ConnectError, httpx2.UnsupportedProtocol, httpx2.InvalidURL) as error:
                    raise self._missing(f"cannot be reached ({_reason(error)})") from error
                except httpx2.HTTPError as error:
                    reason = f"broke off ({_reason(error)})"
                tries = 1 if self._n_received > n_before else tries + 1
                if tries >= _TRIES:
                    raise self._missing(reason)

    def _receive(self, http: httpx2.Client) -> str:
        """Request and keep what has not come yet; returns the reason for another try, or "" where all has come."""
        n_present, headers = self._part.stat().st_size if self._part.exists() else 0, {"Accept-Encoding": "identity"}
        version = self._version.read_text() if self._version.exists() else ""
        if n_present and not version and len(self._sha256 or "") < hashlib.sha256().digest_size * 2:
            n_present = 0  # nothing would tell that the file has changed since
        if n_present:
            headers["Range"] = f"bytes={n_present}-"
            if version:
                headers["If-Range"] = version
        with http.stream("GET", self._url, headers=headers) as answer:
            if answer.status_code == _BEYOND_THE_END and n_present:
                return self._beyond_the_end(answer, n_present)
            if answer.status_code >= 500:
                return f"answered {answer.status_code}"
            if answer.status_code not in {_WHOLE, _PART}:
                raise self._missing(f"answered {answer.status_code}")
            if "text/html" in answer.headers.get("content-type", ""):
                raise self._missing("answered a page, not a file")
            return self._keep(answer, n_present)

    def _beyond_the_end(self, answer: httpx2.Response, n_present: int) -> str:
        """As `_receive`: all has come if the file is as long as the part; else the part is of another file."""
        extent = _CONTENT_RANGE.fullmatch(answer.headers.get("content-range", ""))
        if extent is not None and extent[2] == str(n_present):
            return ""
        self._forget()
        return "has become another file"

    def _keep(self, answer: httpx2.Response, n_present: int) -> str:
        n_total = _content_length(answer)
        if answer.status_code == _PART:
            extent = _CONTENT_RANGE.fullmatch(answer.headers.get("content-range", ""))
            if extent is None or extent[1] != str(n_present):
                self._forget()
                return "answered another part than was asked for"
            n_total = None if extent[2] == "*" else int(extent[2])
        else:
            n_present = 0
        self._check_size(n_total or 0)
        etag = answer.headers.get("etag", "")
        with self._part.open("ab" if n_present else "wb") as part:
            if etag and not etag.startswith("W/"):
                self._version.write_text(etag)
            else:
                self._version.unlink(missing_ok=True)
            for piece in answer.iter_raw():  # as it comes: what a break would lose is never gathered
                part.write(piece)
                n_present += len(piece)
                self._n_received += len(piece)
                self._check_size(n_present)
                self._tell(self._to.name, n_present, n_total)
            part.flush()
            os.fsync(part.fileno())
        return ""

    def _check_size(self, n_bytes: int) -> None:
        if n_bytes > _MOST_BYTES:
            self._forget()
            raise InvalidWeightsError(
                f"{self._url} is larger than any file of weights: {n_bytes} bytes", limit=_MOST_BYTES
            )

    def _finish(self) -> str:
        sha256 = file_sha256(self._part)
        if not matches(sha256, self._sha256):
            self._forget()
        check_digest(self._to.name, sha256, self._sha256, f"what {self._url} sent was not kept{self._digest_advice}")
        self._part.replace(self._to)
        self._version.unlink(missing_ok=True)
        return sha256

    def _missing(self, reason: str) -> MissingWeightsError:
        remains = "" if not self._part.exists() else f"; the {self._part.stat().st_size} bytes that came are kept"
        return _missing(self._url, reason + remains, self._advice)

    def _forget(self) -> None:
        self._part.unlink(missing_ok=True)
        self._version.unlink(missing_ok=True)


def _root(zip_file: zipfile.ZipFile, archive: Path) -> str:
    """The one folder that holds all members, after looking at every one of them."""
    members = zip_file.infolist()
    packed, unpacked = archive.stat().st_size, sum(member.file_size for member in members)
    if len(members) > _MOST_MEMBERS or unpacked > min(_MOST_UNPACKED, _MOST_RATIO * packed):
        raise InvalidWeightsError(
            f"{archive.name} unpacks to {len(members)} files of {unpacked} bytes: more than a repository holds",
            file=archive.name,
        )
    roots = set()
    for member in members:
        path = PurePosixPath(member.orig_filename)
        leads_out = path.is_absolute() or not path.parts or {".."} & {*path.parts} or set("\\:") & {*str(path)}
        if leads_out or stat.S_ISLNK(member.external_attr >> 16):
            raise InvalidWeightsError(f"{archive.name} would write outside its folder: {path}", file=archive.name)
        roots.add(path.parts[0])
    if len(roots) != 1:
        raise InvalidWeightsError(f"{archive.name} holds no single folder, as GitHub's archives do", file=archive.name)
    return roots.pop()


def _missing(url: str, reason: str, advice: str) -> MissingWeightsError:
    return MissingWeightsError(f"{url} {reason}: {advice}", url=url)


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__


def _content_length(answer: httpx2.Response) -> int | None:
    length = answer.headers.get("content-length", "")
    return int(length) if length.isdecimal() else None
