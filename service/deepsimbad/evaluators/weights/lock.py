"""The lock: a file in the weights' folder with the digests of all that was pulled, which every load checks."""

import hashlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError

from deepsimbad.errors import InvalidWeightsError, MissingWeightsError
from deepsimbad.evaluators.weights.files import file_sha256, weights_path
from deepsimbad.evaluators.weights.library import KNOWN, Argument, canonical

LOCK = "weights.lock"
HUB_FOLDER = "hub"
CHECKPOINTS = "checkpoints"
_NOT_CONTENT = "__pycache__"  # Python writes it when it pleases

_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
_Commit = Annotated[str, Field(pattern="^[0-9a-f]{40}$")]
_Side = Annotated[int, Field(ge=1, le=8192)]


@dataclass(frozen=True)
class FileRecord:
    """A file of weights."""

    sha256: _Sha256  # its digest
    n_bytes: int  # its size
    extractor: str  # how a configuration names it
    url: str | None = None  # where it was downloaded; None: it was put there by hand


@dataclass(frozen=True)
class HubRecord:
    """An entry of a torch hub repository, as it was pulled."""

    repository: str  # OWNER/REPO, as it was asked for
    commit: _Commit  # of the repository
    archive_sha256: _Sha256  # of the archive of that commit
    tree_sha256: _Sha256  # of the folder unpacked from it; see `tree_sha256`
    arguments: Mapping[str, Argument]  # what the entry is given
    input_size: tuple[_Side, _Side]  # (width, height) images are brought to
    encoding_dim: Annotated[int, Field(ge=1)]  # d of what it gives
    parameters_sha256: _Sha256  # of the parameters it was loaded with, whatever file they come from
    # digests of the checkpoints and the other repositories' trees in the hub's folder that loading it reads
    beside: Mapping[str, _Sha256]

    @property
    def folder(self) -> str:
        """The name of its tree in the hub's folder."""
        return hub_tree(self.repository, self.commit)

    @property
    def weights_sha256(self) -> str:
        """One digest of all that its encodings depend on."""
        parts = [self.tree_sha256, self.parameters_sha256, repr(sorted(self.arguments.items()))]
        parts += [f"{name} {sha256}" for name, sha256 in sorted(self.beside.items())]
        return hashlib.sha256("\n".join([*parts, f"{self.input_size}"]).encode()).hexdigest()


@dataclass(frozen=True)
class _Document:
    version: Literal[1] = 1
    files: Mapping[str, FileRecord] = field(default_factory=dict)
    hub: Mapping[str, HubRecord] = field(default_factory=dict)


_DOCUMENT: TypeAdapter[_Document] = TypeAdapter(_Document)


@dataclass(frozen=True)
class Finding:
    """A file or tree that was looked at, and whether it is as recorded."""

    path: Path  # of the file or tree
    recorded_sha256: str  # its digest in the lock
    sha256: str | None  # its digest now; None: it is not there

    @property
    def is_good(self) -> bool:
        return self.sha256 == self.recorded_sha256

    def check(self) -> None:
        """Refuse what is not as recorded.

        Raises:
            MissingWeightsError: It is not there.
            InvalidWeightsError: Its digest is another.
        """
        if self.sha256 is None:
            raise MissingWeightsError(f"{self.path} is missing: pull it again", file=self.path.name)
        if not self.is_good:
            raise InvalidWeightsError(
                f"{self.path} has sha256 {self.sha256} and was recorded with {self.recorded_sha256}: it was changed; "
                "remove it and pull it again",
                file=self.path.name, recorded=self.recorded_sha256, found=self.sha256,
            )  # fmt: skip


_KIND_OF_FILE = {"*.onnx": "onnx", "*.mat": "netvlad", "*.pth.tar": "netvlad", "*.npz": "squeezenet"}


@dataclass(frozen=True)
class Lock:
    """The records of one weights' folder."""

    folder: Path
    files: Mapping[str, FileRecord]  # by the name in the folder
    hub: Mapping[str, HubRecord]  # by the extractor's canonical name

    @classmethod
    def read(cls, folder: Path) -> "Lock":
        """The folder's records; none where it has no lock yet; raises InvalidWeightsError."""
        try:
            document = _DOCUMENT.validate_json((folder / LOCK).read_bytes())
        except FileNotFoundError:
            document = _Document()
        except (OSError, ValidationError) as error:
            raise InvalidWeightsError(
                f"{folder / LOCK} is no lock of weights: remove it to record everything anew", file=LOCK
            ) from error
        return cls(folder, document.files, document.hub)

    def extractors(self) -> list[str]:
        """The extractors whose weights lie in the folder, as configurations name them."""
        extractors = {
            weights.extractor
            for weights in KNOWN
            if weights.file is not None and (self.folder / weights.file).is_file()
        }
        for pattern, kind in _KIND_OF_FILE.items():
            extractors |= {f"{kind}:{path.name}" for path in self.folder.glob(pattern)}
        return sorted(extractors) + sorted(self.hub)

    def hub_record(self, extractor: str) -> HubRecord | None:
        """The record of an entry, by its extractor's name; None: it was not pulled."""
        return self.hub.get(canonical(extractor))

    def with_file(self, name: str, record: FileRecord) -> "Lock":
        """The lock with a file recorded, or recorded anew."""
        return replace(self, files={**self.files, name: record})

    def with_hub(self, extractor: str, record: HubRecord) -> "Lock":
        """The lock with an entry recorded, or recorded anew."""
        return replace(self, hub={**self.hub, canonical(extractor): record})

    def write(self) -> None:
        """Replace the folder's lock, whole or not at all."""
        self.folder.mkdir(parents=True, exist_ok=True)
        text = _DOCUMENT.dump_json(_Document(files=self.files, hub=self.hub), indent=2)
        with tempfile.NamedTemporaryFile(dir=self.folder, prefix=f".{LOCK}.", delete=False) as new:
            new.write(text + b"\n")
            new.flush()
            os.fsync(new.fileno())
        Path(new.name).chmod(0o644)  # a folder of weights may be shared
        Path(new.name).replace(self.folder / LOCK)

    def pinned_file(self, name: str) -> tuple[Path, str]:
        """A file of the folder and its SHA-256, which is as recorded where it was pulled.

        Raises:
            MissingWeightsError: It is not there.
            InvalidWeightsError: It was changed since it was pulled.
        """
        path = weights_path(self.folder, name)
        sha256 = file_sha256(path)
        if name in self.files:
            Finding(path, self.files[name].sha256, sha256).check()
        return path, sha256

    def findings(self, name: str) -> Iterator[Finding]:
        """The files and trees that belong to a record, each looked at when its turn comes."""
        if name in self.files:
            yield Finding(self.folder / name, self.files[name].sha256, found_sha256(self.folder / name))
            return
        record, hub = self.hub[canonical(name)], self.folder / HUB_FOLDER
        for part, sha256 in {record.folder: record.tree_sha256, **record.beside}.items():
            yield Finding(hub / part, sha256, found_sha256(hub / part))


def hub_tree(repository: str, commit: str) -> str:
    """Name of the folder that a repository's tree at a commit has in the hub's folder."""
    return f"{repository.replace('/', '_')}_{commit}"


def found_sha256(path: Path) -> str | None:
    """Digest of a file or of a tree; None: there is neither."""
    if path.is_dir():
        return tree_sha256(path)
    return file_sha256(path) if path.is_file() else None


def tree_sha256(folder: Path) -> str:
    """One digest of all files in a folder: their paths and contents, in the order of their paths."""
    tree = hashlib.sha256()
    for path in sorted(folder.rglob("*"), key=lambda file: file.relative_to(folder).as_posix()):
        relative_path = path.relative_to(folder)
        if path.is_file() and _NOT_CONTENT not in relative_path.parts:
            tree.update(f"{file_sha256(path)}  {relative_path.as_posix()}\n".encode())
    return tree.hexdigest()
