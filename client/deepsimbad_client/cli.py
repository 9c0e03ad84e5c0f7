"""`deepsimbad-client`: the console script, which says so in one line where the `replay` extra is not installed."""

import sys

DONE, FAILED = 0, 1
NEEDED = frozenset({"click", "cv2", "matplotlib", "numpy", "rich"})


def main() -> None:
    """Run the command line and exit with its code."""
    try:
        from deepsimbad_client.commands import run  # noqa: PLC0415 - the extra may be missing
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in NEEDED:
            raise
        sys.stderr.write(f"{error.name} is not installed: pip install 'deep-simbad[replay]'\n")
        sys.exit(FAILED)
    sys.exit(run())


if __name__ == "__main__":
    main()
