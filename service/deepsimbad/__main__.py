"""The `deepsimbad` command, which says so in one line where the `service` extra is not installed."""

import os
import sys
from importlib.util import find_spec

PACKAGES = (
    "click",
    "cv2",
    "fastapi",
    "fastapi_offline",
    "jinja2",
    "numba",
    "numpy",
    "prometheus_client",
    "pydantic_settings",
    "sqlite_utils",
    "threadpoolctl",
    "uvicorn",
)


def main() -> None:
    """Run the command line and exit with its code."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        sys.stderr.write(f"{', '.join(missing)} not installed: pip install 'deep-simbad[service]'\n")
        sys.exit(1)
    # OpenBLAS's threads spin for 20 ms after each product, on cores that other work wants; 2^16 cycles are some ten
    # microseconds. Read when NumPy is loaded; an operator may set it otherwise.
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "16")
    try:
        from deepsimbad.cli import run  # noqa: PLC0415 - only now is it known to be there

        code = run()
    except KeyboardInterrupt:  # while it was loaded, which takes a second
        sys.stderr.write("cancelled\n")
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
