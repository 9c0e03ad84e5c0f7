"""Landmark selection among a whole traverse, in a process of its own so that its memory can be read off."""

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from time import perf_counter

import numpy as np

from bench.worlds import ENCODING_DIM, N_LANDMARKS
from deepsimbad.core.landmark_model import select_landmarks

N_CANDIDATES = 26_000


def landmark_table() -> Iterator[str]:
    """Markdown lines."""
    yield "## Landmark selection"
    yield ""
    yield "| candidates | dimensions | landmarks | seconds | peak memory, candidates included |"
    yield "|---|---|---|---|---|"
    run = subprocess.run([sys.executable, "-m", "bench.landmarks"], check=True, capture_output=True, text=True)
    measured = json.loads(run.stdout)
    yield (
        f"| {N_CANDIDATES:,} | {ENCODING_DIM:,} | {N_LANDMARKS} | {measured['seconds']:.1f} "
        f"| {measured['peak_bytes'] / 1e9:.2f} GB |"
    )


def main() -> None:
    """Measure once and print JSON."""
    candidates = np.empty((N_CANDIDATES, ENCODING_DIM), np.float32)
    rng = np.random.default_rng(0)
    for start in range(0, N_CANDIDATES, 1000):  # in blocks: the measured peak is the selection's, not the generator's
        block = rng.standard_normal((1000, ENCODING_DIM), dtype=np.float32)
        candidates[start : start + 1000] = block / np.linalg.norm(block, axis=1, keepdims=True)
    select_landmarks(candidates[:2000], 10)  # compile
    began = perf_counter()
    select_landmarks(candidates, N_LANDMARKS)
    seconds = perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    sys.stdout.write(json.dumps({"seconds": seconds, "peak_bytes": peak}))


if __name__ == "__main__":
    main()
