"""Which map served before the present one."""

from collections.abc import Sequence

from deepsimbad_client.errors import NoEarlierMapError
from deepsimbad_client.models import MapVersion


def served_before(domain: str, maps: Sequence[MapVersion]) -> tuple[int | None, int]:
    """The active version (None: there is none) and the one that served last before it.

    Raises:
        NoEarlierMapError: No other version has served, or their files were removed.
    """
    active = next((each.version for each in maps if each.state == "active"), None)
    earlier = [each for each in maps if each.state == "retired" and each.removed_at is None]
    if not earlier:
        raise NoEarlierMapError(
            f"no map of domain {domain} has served before the present one and is still there: "
            f"list them with `deepsimbad-client maps {domain}`"
        )
    # Times of one form sort as texts; a service that does not tell them has the highest number last.
    return active, max(earlier, key=lambda each: (each.retired_at or "", each.version)).version
