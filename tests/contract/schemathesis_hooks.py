"""What schemathesis cannot know of the service: images and batches that get behind the decoders, and one meaning.

Loaded by the command `schemathesis`, in its own process; not a test.
"""

import io

import cv2
import numpy as np
import schemathesis
from hypothesis import strategies as st
from schemathesis.openapi.checks import UseAfterFree

DIM = 2304  # of the embedded extractor


def _images(extension):
    def image(seed):
        pixels = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), np.uint8)
        return bytes(cv2.imencode(extension, pixels)[1].tobytes())

    images = st.integers(0, 9).map(image)
    return st.one_of(images, st.binary(max_size=64), st.tuples(images, st.integers(0, 200)).map(lambda c: c[0][: c[1]]))


def _batch(n):
    file = io.BytesIO()
    encodings = np.random.default_rng(n).normal(size=(n, DIM)).astype(np.float32)
    np.savez(file, encodings=encodings, index=np.arange(n), position_m=np.arange(n, dtype=float))
    return file.getvalue()


for _type, _extension in (("jpeg", ".jpg"), ("png", ".png"), ("tiff", ".tiff"), ("webp", ".webp")):
    schemathesis.openapi.media_type(f"image/{_type}", _images(_extension))
schemathesis.openapi.media_type("application/octet-stream", st.one_of(st.integers(0, 5).map(_batch), st.binary()))
schemathesis.openapi.media_type(
    "application/vnd.deepsimbad.ranks",
    st.one_of(
        st.integers(1, 3).map(lambda m: m.to_bytes(2, "big") + bytes([0b0000_0001, 0b0010_0000])[: (m + 1) // 2]),
        st.binary(max_size=8),
    ),
)
schemathesis.openapi.media_type(
    "application/vnd.deepsimbad.unit-encoding",
    st.one_of(st.binary(min_size=3, max_size=3).map(lambda codes: b"\x03" + codes), st.binary(max_size=8)),
)


@schemathesis.hook
def filter_failure(context, failure, case, response):
    """Deleting a job cancels it: what became of it can still be asked."""
    return not (isinstance(failure, UseAfterFree) and case.path.startswith("/v1/admin/jobs/"))
