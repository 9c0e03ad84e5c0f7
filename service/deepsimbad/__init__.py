"""Active landmark-based self-localization as a service."""

from functools import cache
from importlib.metadata import version


@cache
def release() -> str:
    """The number of the release that runs, whatever is installed beside it meanwhile."""
    return version("deep-simbad")
