"""The last steps of every job that makes a map: the next version written, sealed and noted."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from deepsimbad.core.map import Map
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import AnyVersion
from deepsimbad.store.map_file import index_bytes, write_map
from deepsimbad.store.records import MapRecord
from deepsimbad.store.sealing import seal


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
