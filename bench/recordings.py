"""The real recordings, and drives of them as the service encodes them."""

import os
from functools import cache
from pathlib import Path

from bench.measurement import PROJECT
from deepsimbad.core.drive import Drive
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.build import encode_recording
from deepsimbad_client.recordings.sources import open_source

NETVLAD = ("nr", "nq", "nq2")
MAX_PIXELS = 50_000_000


def real_recordings() -> Path:
    """The folder named by DEEPSIMBAD_REAL_DATA, else `../shared/data` beside the project.

    Raises:
        FileNotFoundError: There is none.
    """
    folder = Path(os.environ.get("DEEPSIMBAD_REAL_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise FileNotFoundError(f"no real recordings at {folder}: set DEEPSIMBAD_REAL_DATA to their folder")
    return folder


@cache
def evaluator_of(extractor: str | None = None) -> Evaluator:
    """Plain L2 of encodings by an extractor; None: the default one."""
    return make_evaluator(evaluator_config({"kind": "feature_l2"} | ({"extractor": extractor} if extractor else {})))


def encoded(source: str | Path, extractor: str | None = None) -> Drive:
    """A recording's drive by an extractor, None: the default one; ready encodings as they are."""
    recording = open_source(str(source))
    evaluator = evaluator_of(extractor if recording.encodings is None else "none")
    return encode_recording(recording, evaluator, MAX_PIXELS, lambda _: None).drive


def netvlad_drives() -> list[Drive]:
    """Three drives of the Nordland railway, 600 places a metre apart, as 64 numbers of NetVLAD each."""
    return [encoded(real_recordings() / "nordland_netvlad64" / f"{name}.npy") for name in NETVLAD]
