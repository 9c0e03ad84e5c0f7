"""Any model of a torch hub repository: pulled once at a commit, and from then on loaded as it was, without a network.

Loading runs the repository's code, so it comes by `deepsimbad weights pull` alone, whose user agreed to that, and is
held to its digests at every load.
"""

import contextlib
import hashlib
import io
import os
import re
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast
from urllib.error import URLError

import numpy as np
import torch
from torch import Tensor, nn

from deepsimbad.errors import (
    DeepSimbadError,
    InvalidWeightsError,
    MissingPackageError,
    MissingWeightsError,
    OutOfMemoryError,
)
from deepsimbad.evaluators.base import is_lack_of_memory
from deepsimbad.evaluators.compute import Compute, Runtime
from deepsimbad.evaluators.extractors.base import IMAGENET_MEAN, IMAGENET_STD, NetworkExtractor
from deepsimbad.evaluators.runtimes import make_run
from deepsimbad.evaluators.weights.downloads import check_digest
from deepsimbad.evaluators.weights.files import encodings_sha256, file_sha256
from deepsimbad.evaluators.weights.library import HUB, Argument
from deepsimbad.evaluators.weights.lock import CHECKPOINTS, HUB_FOLDER, HubRecord, Lock

_RECIPE = 1  # see `encodings_sha256`
_NETWORK_EVENTS = {"urllib.Request", "socket.getaddrinfo", "socket.gethostbyname"}
# A nested `torch.hub.load` asks this first, and uses the local repository where nobody answers.
_BRANCH_QUESTION = re.compile(r"https://github\.com/[^/]+/[^/]+/tree/main/")

Download = Callable[[str, Path], None]
"""Downloads an address to a path, as an entry asks torch hub to."""


def torchhub(argument: str, compute: Compute) -> NetworkExtractor:
    """Make the extractor for the registry, by default in float32; raises as `Evaluator.load`."""
    extractor, lock = f"{HUB}{argument}", Lock.read(compute.weights_dir)
    record = lock.hub_record(extractor)
    if record is None:
        raise MissingWeightsError(
            f"{extractor} was not pulled: `deepsimbad weights pull {extractor}` brings it to {compute.weights_dir}",
            extractor=extractor,
        )
    trunk = load_recorded(lock, extractor, record)
    in_float32 = replace(compute, runtime=Runtime.TORCH) if compute.runtime is Runtime.AUTO else compute
    run = make_run(lambda: HubModule(trunk, extractor, record.encoding_dim), in_float32, record.input_size)
    width, height = record.input_size
    with _named_failures(extractor, f"cannot be run in {in_float32.runtime.value}"):
        run(np.zeros((1, height, width, 3), np.uint8))
    sha256 = encodings_sha256(record.weights_sha256, _RECIPE)
    return NetworkExtractor(run, record.encoding_dim, sha256, record.input_size)


class HubModule(nn.Module):
    """Pixels [n, height, width, 3] uint8 BGR to encodings [n, d] float32 of unit length.

    Args:
        trunk: The repository's model, from images [n, 3, height, width] normalised as ImageNet's.
        extractor: Name of the extractor, for the errors.
        encoding_dim: d that the trunk must give; None: any.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, trunk: nn.Module, extractor: str, encoding_dim: int | None) -> None:
        super().__init__()
        self.trunk = trunk
        self._extractor, self._encoding_dim = extractor, encoding_dim
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1))

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class; raises InvalidWeightsError."""
        images = (pixels.permute(0, 3, 1, 2).flip(1).float() / 255.0 - self.mean) / self.std
        parameter = next(self.trunk.parameters(), None)
        output = self.trunk(images if parameter is None else images.to(parameter.dtype))
        encodings = self._encodings(output, len(pixels)).float()
        if not torch.isfinite(encodings).all():
            raise InvalidWeightsError(f"{self._extractor} gives NaN or infinity", extractor=self._extractor)
        length = torch.linalg.vector_norm(encodings, dim=1, keepdim=True)
        neutral = encodings.new_full((), encodings.shape[1] ** -0.5)  # where it sees nothing at all
        return torch.where(length > 0, encodings / length.clamp_min(torch.finfo(torch.float32).tiny), neutral)

    def _encodings(self, output: Any, n: int) -> Tensor:
        """[n, d] the encodings in a trunk's output: the output itself, or the first fitting one of several."""
        parts = output if isinstance(output, tuple | list) else (output,)
        for part in parts:
            if isinstance(part, Tensor) and part.ndim == 2 and len(part) == n and part.is_floating_point():
                if self._encoding_dim in {None, part.shape[1]}:
                    return part
                raise InvalidWeightsError(
                    f"{self._extractor} gives encodings of {part.shape[1]} numbers, not {self._encoding_dim}",
                    extractor=self._extractor,
                )
        shapes = ", ".join(str(list(part.shape)) if isinstance(part, Tensor) else type(part).__name__ for part in parts)
        raise InvalidWeightsError(
            f"{self._extractor} gives {shapes or 'nothing'} for {n} images, and no encodings [{n}, d]",
            extractor=self._extractor,
        )


def parameters_sha256(module: nn.Module) -> str:
    """One digest of a module's parameters and buffers: names, types, shapes and values."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        if isinstance(tensor, Tensor):
            digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


@dataclass(frozen=True)
class LoadedEntry:
    """A model that an entry gave."""

    trunk: nn.Module
    encoding_dim: int  # d of its encodings
    companions: list[str]  # the checkpoints and the other repositories' trees in the hub's folder that it read


@dataclass(frozen=True)
class HubEntry:
    """An entry of a repository that lies in the hub's folder."""

    extractor: str  # torchhub:OWNER/REPO:ENTRY
    hub: Path  # the hub's folder
    tree: Path  # the repository's folder in it
    arguments: Mapping[str, Argument]  # of the entry
    input_size: tuple[int, int]  # (width, height) of its images
    encoding_dim: int | None  # d it must give; None: any

    def load(self, download: Download | None) -> LoadedEntry:
        """Run the entry, and try the model that it gives on two images.

        Args:
            download: Downloads what it asks torch hub for; None: nothing may be downloaded.

        Raises:
            MissingWeightsError: It wanted to download something, and may not or cannot.
            InvalidWeightsError: It fails, or gives no model of encodings.
            MissingPackageError: It needs a package that is not installed.
            OutOfMemoryError: There is too little memory for it.
        """
        entry, (width, height) = self.extractor.rpartition(":")[2], self.input_size
        with _as_torch_hub_wants_it(self.hub, download) as watch:
            with _named_failures(self.extractor, "cannot be made", self.tree, watch):
                model = cast("Callable[..., Any]", torch.hub.load)(
                    str(self.tree), entry, source="local", verbose=False, **self.arguments
                )
            while isinstance(model, nn.DataParallel):  # the service shares devices out itself
                model = model.module
            if not isinstance(model, nn.Module):
                raise InvalidWeightsError(
                    f"{self.extractor} gives a {type(model).__name__}, no model", extractor=self.extractor
                )
            module = HubModule(model, self.extractor, self.encoding_dim).eval()
            does_not = f"does not take images of {width} x {height}"
            with _named_failures(self.extractor, does_not, self.tree, watch), torch.inference_mode():
                encodings = module(torch.zeros((2, height, width, 3), dtype=torch.uint8))
        return LoadedEntry(model, encodings.shape[1], watch.companions(self.hub, self.tree))


def load_recorded(lock: Lock, extractor: str, record: HubRecord) -> nn.Module:
    """The model of a record, from local files alone: they are held to their digests first, then its parameters.

    Raises:
        MissingWeightsError, InvalidWeightsError, MissingPackageError, OutOfMemoryError: As `torchhub`.
    """
    for finding in lock.findings(extractor):
        finding.check()
    hub = lock.folder.absolute() / HUB_FOLDER
    entry = HubEntry(
        extractor, hub, hub / record.folder, record.arguments, record.input_size, record.encoding_dim
    )  # fmt: skip
    trunk = entry.load(None).trunk
    check_digest(
        f"{extractor}'s parameters", parameters_sha256(trunk), record.parameters_sha256,
        "they are not the same each time it is loaded, or were changed",
    )  # fmt: skip
    return trunk


@dataclass
class _Watch:
    """Records the files that the thread that loads an entry opens, and the addresses that it may not ask."""

    may_ask: bool
    opened_files: set[str] = field(default_factory=set)
    refused_addresses: list[str] = field(default_factory=list)

    def see(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Take an audit event of this thread."""
        if event == "open" and isinstance(arguments[0], str):
            self.opened_files.add(arguments[0])
        elif not self.may_ask and event in _NETWORK_EVENTS:
            self.refuse(str(arguments[0]))
        elif not self.may_ask and event == "socket.connect" and isinstance(arguments[1], tuple):
            self.refuse(str(arguments[1]))  # a text would be a socket of this machine

    def refuse(self, address: str) -> None:
        """Let a request fail as it does without a network."""
        if _BRANCH_QUESTION.fullmatch(address) is None:
            self.refused_addresses.append(address)
        raise URLError(f"{address} is not asked: models are loaded from the weights' folder alone")

    def companions(self, hub: Path, tree: Path) -> list[str]:
        """The checkpoints that were opened, and the other repositories' trees of which a file was."""
        opened_files = [Path(name).absolute() for name in self.opened_files]
        hub_parts = [
            path.relative_to(hub).parts for path in opened_files if path.is_relative_to(hub) and path.is_file()
        ]
        files = {"/".join(parts) for parts in hub_parts if parts[0] == CHECKPOINTS}
        trees = {parts[0] for parts in hub_parts if (hub / parts[0] / "hubconf.py").is_file()} - {tree.name}
        return sorted(files | trees)


_loading = threading.Lock()  # the changes below are to the whole process
_of_this_thread = threading.local()
_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    watch = getattr(_of_this_thread, "watch", None)
    if watch is not None:
        watch.see(event, arguments)


@contextlib.contextmanager
def _as_torch_hub_wants_it(hub: Path, download: Download | None) -> Iterator[_Watch]:
    """Change the process to what a repository's code expects; afterwards it is as before, and module names are free.

    The code's output is kept off standard output, where it would be taken for an answer.
    """
    global _hooked  # noqa: PLW0603 - a hook cannot be taken back
    with _loading, warnings.catch_warnings(), contextlib.ExitStack() as cleanup:
        warnings.simplefilter("ignore")
        if not _hooked:
            sys.addaudithook(_hook)
            _hooked = True
        watch = _Watch(may_ask=download is not None)

        def bring(url: str, dst: str, hash_prefix: str | None = None, progress: bool = True) -> None:
            del progress
            if download is None:
                watch.refuse(f"{url} for {dst}")
            else:
                download(url, Path(dst))
                check_digest(dst, file_sha256(Path(dst)), hash_prefix, "its repository wants another")

        def trusted(*_: object, **__: object) -> None:
            """Whoever pulled the entry agreed to its code, and so to what that loads."""

        hub.mkdir(parents=True, exist_ok=True)
        modules, paths = set(sys.modules), list(sys.path)
        cleanup.callback(torch.hub.set_dir, torch.hub.get_dir())
        torch.hub.set_dir(hub)
        for holder, name, replacement in (
            (torch.hub, "download_url_to_file", bring),
            (torch.hub, "_check_repo_is_trusted", trusted),
            (sys, "dont_write_bytecode", True),
            (sys, "pycache_prefix", str(hub / ".no-pycache")),  # compiled code in a tree is not among its digests
        ):
            cleanup.callback(setattr, holder, name, getattr(holder, name))
            setattr(holder, name, replacement)
        home = os.environ.get("HF_HOME")
        os.environ["HF_HOME"] = str(hub / "huggingface")  # where huggingface_hub puts what it downloads
        out = sys.stderr if download is not None else io.StringIO()
        cleanup.enter_context(contextlib.redirect_stdout(out))
        cleanup.enter_context(contextlib.redirect_stderr(out))
        _of_this_thread.watch = watch
        try:
            yield watch
        finally:
            _of_this_thread.watch = None
            sys.path[:] = paths
            for name in set(sys.modules) - modules:
                origin = getattr(sys.modules[name], "__file__", None) or ""
                if Path(origin).is_relative_to(hub):
                    del sys.modules[name]
            if home is None:
                os.environ.pop("HF_HOME", None)
            else:
                os.environ["HF_HOME"] = home


@contextlib.contextmanager
def _named_failures(
    extractor: str, problem: str, tree: Path | None = None, watch: _Watch | None = None
) -> Iterator[None]:
    """Whatever foreign code raises, as one of our errors."""
    try:
        yield
    except DeepSimbadError:
        raise
    except (Exception, SystemExit) as error:
        text = f"{type(error).__name__}: {error}"
        if is_lack_of_memory(error):
            raise OutOfMemoryError(f"there is too little memory for {extractor}") from error
        if watch is not None and watch.refused_addresses:
            raise MissingWeightsError(
                f"{extractor} wants {watch.refused_addresses[-1]}, and nothing is downloaded while it is loaded: "
                f"pull it again, `deepsimbad weights pull {extractor}`",
                extractor=extractor, url=watch.refused_addresses[-1],
            ) from error  # fmt: skip
        package = _missing_package(error, tree)
        if package is not None:
            raise MissingPackageError(
                f"{extractor} needs {package}, which is not installed here: pip install it beside the service",
                extractor=extractor, package=package,
            ) from error  # fmt: skip
        raise InvalidWeightsError(f"{extractor} {problem}: {text}", extractor=extractor) from error


def _missing_package(error: BaseException, tree: Path | None) -> str | None:
    """The package whose absence an error reports, unless the repository has a module of that name; else None."""
    missing = re.match(r"Missing dependencies: (.+)", str(error))  # by torch hub, of a repository's own list
    if missing is not None:
        return missing[1]
    if not isinstance(error, ModuleNotFoundError) or error.name is None:
        return None
    name = error.name.partition(".")[0]
    is_its_own = tree is not None and ((tree / name).exists() or (tree / f"{name}.py").exists())
    return None if is_its_own else name
