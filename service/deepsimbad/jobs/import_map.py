"""A sealed map of another server becomes the next version of a domain here, byte for byte."""

from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import Any

from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import DamagedMapError, DeepSimbadError, InvalidArchiveError, InvalidInputError
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.durable import sha256_of
from deepsimbad.store.layout import is_name
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.map_file import index_bytes, read_map
from deepsimbad.store.records import MapRecord
from deepsimbad.store.sealing import adopt

# Traverses of the server where it was made: one of the same name here would be another drive.
_NAMES_THERE = ("training_traverse", "landmark_traverse", "check_traverse")


@dataclass(frozen=True)
class ImportReport:
    """What was imported as which version, whether it serves, and whether the domain is new."""

    domain: str
    map_version: int
    active: bool
    domain_is_new: bool
    bytes: int
    sha256: str


def import_map(
    catalog: Catalog, file: Path, domain: str | None = None, sha256: str | None = None, *, activate: bool = True
) -> ImportReport:
    """Take over a map file that another server exported.

    Args:
        catalog: Of the data directory.
        file: The map file; it stays.
        domain: What the domain is called here; None: as there. It is made if it is absent.
        sha256: The digest in hex that the file must have; None: any.
        activate: Whether the map shall serve at once.

    Raises:
        InvalidArchiveError: The file is no sealed map, is damaged, or has another digest.
        InvalidInputError: The domain cannot be called so.
        DomainDiffersError: The domain exists with another evaluator, other actions or the other kind of route.
        UnavailableError: The disk is full, ...
    """
    digest, contents, metrics = _read(file, sha256)
    name = contents.domain if domain is None else domain
    _, is_new = catalog.create_domain(name, contents.evaluator, contents.closed, contents.actions_m)
    try:
        record = _adopt(catalog, name, file, digest, contents, metrics)
    except BaseException:
        if is_new:
            with suppress(DeepSimbadError):  # the first error is the one to tell
                catalog.delete_domain(name, only_empty=True)  # somebody may have begun to use it meanwhile
        raise
    if activate:
        record = catalog.activate(name, record.version, ANY)
    return ImportReport(name, record.version, activate, is_new, record.file_bytes or 0, digest)


def _adopt(
    catalog: Catalog, domain: str, file: Path, digest: str, contents: MapContents, metrics: dict[str, Any]
) -> MapRecord:
    config = {name: value for name, value in contents.config.items() if name != "appended"}
    config |= dict.fromkeys(_NAMES_THERE)
    config["imported"] = {"domain": contents.domain, "version": contents.version, "sha256": digest}
    version = catalog.begin_map(domain, config)
    try:
        n_bytes = adopt(file, catalog.map_path(domain, version), digest)
        return catalog.seal_map(domain, version, digest, n_bytes, metrics)
    except BaseException:
        catalog.discard_map(domain, version)
        raise


def _read(file: Path, sha256: str | None) -> tuple[str, MapContents, dict[str, Any]]:
    """Digest, contents and metrics of a file that can serve here."""
    try:
        digest = sha256_of(file)
    except OSError as error:
        raise InvalidArchiveError(f"{file} cannot be read: {error.strerror}", file=str(file)) from error
    if sha256 is not None and digest != sha256.strip().lower().removeprefix("sha256:"):
        raise InvalidArchiveError(f"{file} is another file: its SHA-256 is {digest}", file=str(file), sha256=digest)
    try:
        contents = read_map(file)
        if not is_name(contents.domain):
            raise DamagedMapError(f"{file.name} is damaged: its domain has no name")
        _check_actions(contents.actions_m)
        make_evaluator(evaluator_config(contents.evaluator)).check_model(contents.landmark_model, contents.n_landmarks)
        n_bytes = index_bytes(file)
        snapshot = MapSnapshot.from_contents(contents, n_bytes)
    except (DeepSimbadError, KeyError, TypeError, ValueError, OverflowError) as error:
        why = error.message if isinstance(error, DeepSimbadError) else "its parts contradict each other"
        raise InvalidArchiveError(f"{file} is no map that can serve here: {why}", file=str(file)) from error
    measured = {"n_map_images": snapshot.n_images, "index_bits_per_map_image": snapshot.index_bits_per_map_image}
    return digest, contents, {**contents.metrics, **measured}


def _check_actions(actions_m: tuple[float, ...]) -> None:
    """The file did not come through the door at which domains are made; raises InvalidInputError."""
    ascends = all(shorter < longer for shorter, longer in pairwise((0.0, *actions_m)))
    if not actions_m or not ascends or not isfinite(actions_m[-1]):
        raise InvalidInputError(f"its actions_m {list(actions_m)} are no moves that ascend")
