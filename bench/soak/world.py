"""The domain that the robots drive through: a loop, two drives of it, and how its first map is made."""

import io
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.soak.link import Link

DOMAIN = "loop"
BASE = f"/v1/admin/domains/{DOMAIN}"
N_IMAGES, N_LANDMARKS, DIM, SPACING_M = 400, 50, 16, 0.5
NPZ = {"Content-Type": "application/octet-stream"}
DRIVES = ("spring", "summer")


def encodings_of(seed: int) -> NDArray[np.float32]:
    """[n, d] of one drive: the places alike in both, the season not."""
    places = np.random.default_rng(0).normal(size=(N_IMAGES, DIM))
    season = np.random.default_rng([1, seed]).normal(size=(N_IMAGES, DIM))
    return (places + 0.3 * season).astype(np.float32)


def packed(**arrays: Any) -> bytes:
    """An npz file."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def upload(link: Link, name: str, encodings: NDArray[np.float32]) -> None:
    """One drive around the loop."""
    n = np.arange(len(encodings))
    link.ask("POST", f"{BASE}/traverses", {"name": name})
    batch = packed(encodings=encodings, index=n, position_m=n * SPACING_M)
    link.ask("POST", f"{BASE}/traverses/{name}/frames", batch, NPZ)


def remap_config(training: str, landmarks: str | None, **more: Any) -> dict[str, Any]:
    """The body of a remap, small enough to be over in a second."""
    config = {"training_traverse": training, "landmark_traverse": landmarks, "training_episodes": 200, **more}
    return config if landmarks is None else {**config, "n_landmarks": N_LANDMARKS}


def make_domain(link: Link) -> None:
    """The domain, its drives and its first map."""
    link.ask("PUT", BASE, {"evaluator": {"kind": "feature_l2"}, "closed": True})  # the embedded extractor
    for seed, name in enumerate(DRIVES):
        upload(link, name, encodings_of(seed))
    job = link.ask("POST", f"{BASE}/remaps", remap_config(*DRIVES))
    while job["state"] in {"queued", "running"}:
        time.sleep(0.05)
        job = link.ask("GET", f"/v1/admin/jobs/{job['job_id']}")
    if job["state"] != "succeeded":
        raise RuntimeError(f"the first map failed: {job}")
