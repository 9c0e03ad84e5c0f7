"""Which release of the product runs."""

from importlib.metadata import PackageNotFoundError, version


def release() -> str:
    """The release's number; "0" where it runs from a source tree that was never installed."""
    try:
        return version("deep-simbad")
    except PackageNotFoundError:
        return "0"
