"""Active landmark-based self-localization as a service."""

from importlib.metadata import version


def release() -> str:
    """The number of the release that runs."""
    return version("deep-simbad")
