"""`deepsimbad-client`: the console script, which says so in one line where the `replay` extra is not installed."""

import sys
from importlib.util import find_spec

NEEDED = ("click", "cv2", "matplotlib", "numpy", "rich")


def main() -> None:
    """Run the command line and exit with its code."""
    missing_names = [name for name in NEEDED if find_spec(name) is None]
    if missing_names:
        sys.stderr.write(f"{', '.join(missing_names)} not installed: pip install 'deep-simbad[replay]'\n")
        sys.exit(1)
    try:
        from deepsimbad_client.commands import run  # noqa: PLC0415 - only now are its packages known to be installed

        code = run()
    except KeyboardInterrupt:  # while it was loaded, which takes a second
        sys.stderr.write("deepsimbad-client: cancelled\n")
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
