"""The last steps of every job that makes a map: the next version written, sealed and noted."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.map_file import index_bytes, write_map
from deepsimbad.store.records import MapRecord
from deepsimbad.store.sealing import seal


def seal_version(
    catalog: Catalog,
    domain: str,
    contents: MapContents,
    config: Mapping[str, Any],
    metrics: Mapping[str, Any],
    on_progress: Callable[[float], None],
) -> MapRecord:
    """Write and seal a map as the domain's next version; a failure or cancel leaves nothing of it.

    Args:
        catalog: Of the data directory.
        domain: Whose map it is.
        contents: What it holds; its version and time are set here.
        config: What was asked for; kept in the catalog.
        metrics: What was measured; the size of the index is added.
        on_progress: Called with the share written; may raise to cancel.

    Returns:
        The sealed version; it does not serve yet.
    """
    version = catalog.begin_map(domain, dict(config))
    try:
        building, sealed = catalog.building_path(domain, version), catalog.map_path(domain, version)
        created_at = datetime.now(UTC).isoformat(timespec="seconds")
        write_map(building, replace(contents, version=version, created_at=created_at), on_progress)
        digest, n_bytes = seal(building, sealed)
        bits = 8 * index_bytes(sealed) / contents.n_map_images
        on_progress(1.0)
        return catalog.seal_map(domain, version, digest, n_bytes, {**metrics, "index_bits_per_map_image": bits})
    except BaseException:
        catalog.discard_map(domain, version)
        raise
