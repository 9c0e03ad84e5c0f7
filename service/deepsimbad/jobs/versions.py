"""New versions of a domain's map: what a job made is sealed, what another server exported is taken over."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from deepsimbad.core.map import Map
from deepsimbad.errors import DamagedMapError, DeepSimbadError, InvalidArchiveError
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.store.catalog import ANY, AnyVersion, Catalog
from deepsimbad.store.durable import sha256_of
from deepsimbad.store.layout import is_name
from deepsimbad.store.map_file import adopt, index_bytes, read_map, seal, write_map
from deepsimbad.store.records import MapRecord

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
        file: The map file; it stays.
        domain: What the domain is called here; None: as there. It is made if it is absent.
        sha256: The digest in hex that the file must have; None: any.

    Raises:
        InvalidArchiveError: The file is no sealed map, is damaged, or has another digest.
        InvalidInputError: The domain cannot be called so.
        DomainDiffersError: The domain exists with another evaluator, other actions or the other kind of route.
        UnavailableError: The disk is full, ...
    """
    digest, map_, metrics = _read(file, sha256)
    name = map_.domain if domain is None else domain
    _, is_new = catalog.create_domain(name, dict(map_.evaluator), map_.closed, map_.actions_m.tolist())
    try:
        record = _adopt(catalog, name, file, digest, map_, metrics)
    except BaseException:
        if is_new:
            with suppress(DeepSimbadError):  # the first error is the one to tell
                catalog.delete_domain(name, only_empty=True)  # somebody may have begun to use it meanwhile
        raise
    if activate:
        record = catalog.activate(name, record.version, ANY)
    return ImportReport(name, record.version, activate, is_new, record.file_bytes or 0, digest)


def _adopt(catalog: Catalog, domain: str, file: Path, digest: str, map_: Map, metrics: dict[str, Any]) -> MapRecord:
    config = {name: value for name, value in map_.config.items() if name != "appended"}
    config |= dict.fromkeys(_NAMES_THERE)
    config["imported"] = {"domain": map_.domain, "version": map_.version, "sha256": digest}
    version = catalog.begin_map(domain, config)
    try:
        n_bytes = adopt(file, catalog.map_path(domain, version), digest)
        return catalog.seal_map(domain, version, digest, n_bytes, metrics)
    except BaseException:
        catalog.discard_map(domain, version)
        raise


def _read(file: Path, sha256: str | None) -> tuple[str, Map, dict[str, Any]]:
    """Digest, map_ and metrics of a file that can serve here."""
    try:
        digest = sha256_of(file)
    except OSError as error:
        raise InvalidArchiveError(f"{file} cannot be read: {error.strerror}", file=str(file)) from error
    if sha256 is not None and digest != sha256.strip().lower().removeprefix("sha256:"):
        raise InvalidArchiveError(f"{file} is another file: its SHA-256 is {digest}", file=str(file), sha256=digest)
    try:
        map_ = read_map(file)
        if not is_name(map_.domain):
            raise DamagedMapError(f"{file.name} is damaged: its domain has no name")
        map_.check()
        make_evaluator(evaluator_config(map_.evaluator)).check_model(map_.landmark_model, map_.n_landmarks)
    except (DeepSimbadError, KeyError, TypeError, ValueError, OverflowError) as error:
        why = error.message if isinstance(error, DeepSimbadError) else "its parts contradict each other"
        raise InvalidArchiveError(f"{file} is no map that can serve here: {why}", file=str(file)) from error
    measured = {"n_map_images": map_.n_images, "index_bits_per_map_image": map_.index_bits_per_map_image}
    return digest, map_, {**map_.metrics, **measured}


def seal_version(
    catalog: Catalog,
    domain: str,
    map_: Map,
    config: Mapping[str, Any],
    metrics: Mapping[str, Any],
    on_progress: Callable[[float], None],
    job_id: str | None,
) -> MapRecord:
    """Write and seal a map as the domain's next version; a failure or cancel leaves nothing of it.

    Args:
        catalog: Of the data directory.
        domain: Whose map it is.
        map_: What it holds; its domain, version and time are set here.
        config: What was asked for; kept in the catalog.
        metrics: What was measured; the size of the index is added.
        on_progress: Called with the share written; may raise to cancel.
        job_id: Whose work it is; kept with the metrics in the transaction that seals the version, so that the job, once
            interrupted, finds what it made (`Catalog.map_of_job`) and does not make it twice.

    Returns:
        The sealed version; it does not serve yet.
    """
    version = catalog.begin_map(domain, dict(config))
    try:
        building, sealed = catalog.building_path(domain, version), catalog.map_path(domain, version)
        created_at = datetime.now(UTC).isoformat(timespec="seconds")
        write_map(building, replace(map_, domain=domain, version=version, created_at=created_at), on_progress)
        digest, n_bytes = seal(building, sealed)
        bits = 8 * index_bytes(sealed) / map_.n_images
        on_progress(1.0)
        measured = {**metrics, "index_bits_per_map_image": bits, "job_id": job_id}
        return catalog.seal_map(domain, version, digest, n_bytes, measured)
    except BaseException:
        catalog.discard_map(domain, version)
        raise


def activate_once(catalog: Catalog, domain: str, sealed: MapRecord, expected: int | AnyVersion | None) -> None:
    """Let a version serve that a job has sealed, unless that was done before the job was interrupted.

    Args:
        catalog: Of the data directory.
        domain: Whose map it is.
        sealed: The version.
        expected: As for `Catalog.activate`.

    Raises:
        LostActivationError: Another version is active than the expected one.
    """
    if sealed.activated_at is None:  # else it served already, and whoever rolled it back since meant it
        catalog.activate(domain, sealed.version, expected)
