"""`deepsimbad-client`: the console script, which says so in one line where the `replay` extra is not installed."""

import sys
from importlib.util import find_spec

NEEDED = ("click", "cv2", "matplotlib", "numpy", "rich")


def main() -> None:
    """Run the command line and exit with its code."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        sys.stderr.write(f"{', '.join(missing)} not installed: pip install 'deep-simbad[replay]'\n")
        sys.exit(1)
    from deepsimbad_client.commands import run  # noqa: PLC0415 - only now is it known to be there

    sys.exit(run())


if __name__ == "__main__":
    main()
