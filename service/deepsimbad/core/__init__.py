"""The algorithm: arrays in, arrays out. No I/O, no clock, no logging, no global random state."""

import sys
from importlib import import_module

if "scipy.linalg" not in sys.modules:  # Numba would load it where it is installed: 0.2 s, and no loop of ours calls it
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
    try:
        import_module("numba.np.arraymath")
    finally:
        del sys.modules["scipy.linalg"]
