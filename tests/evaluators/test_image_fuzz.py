"""Any bytes give an image or a named error, never a crash."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deepsimbad.errors import DeepSimbadError
from deepsimbad.evaluators.image import decode_image

LIMIT = 200_000
PREFIXES = (
    b"\xff\xd8\xff",
    b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR",
    b"II*\x00\x08\x00\x00\x00",
    b"MM\x00*\x00\x00\x00\x08",
    b"RIFF\x40\x00\x00\x00WEBPVP8 ",
    b"RIFF\x40\x00\x00\x00WEBPVP8X",
    b"",
)
FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def _image_or_named_error(body: bytes) -> None:
    try:
        image = decode_image(body, LIMIT)
    except DeepSimbadError:
        return
    assert image.dtype == np.uint8
    assert image.ndim == 3
    assert image.shape[2] == 3
    assert 0 < image.shape[0] * image.shape[1] <= LIMIT


@FUZZ
@given(prefix=st.sampled_from(PREFIXES), rest=st.binary(max_size=300))
def test_any_bytes(prefix, rest):
    _image_or_named_error(prefix + rest)


@FUZZ
@given(data=st.data())
def test_damaged_files(files, data):
    body = bytearray(files[data.draw(st.sampled_from(sorted(files)))])
    for place in data.draw(st.lists(st.integers(0, len(body) - 1), min_size=1, max_size=6)):
        body[place] = data.draw(st.integers(0, 255))
    _image_or_named_error(bytes(body[: data.draw(st.integers(len(body) // 2, len(body)))]))


@pytest.mark.slow
@settings(FUZZ, max_examples=3000)
@given(data=st.data())
def test_damaged_headers_at_length(files, data):
    body = bytearray(files[data.draw(st.sampled_from(sorted(files)))])
    near = min(len(body), 220)
    for place in data.draw(st.lists(st.integers(0, near - 1), min_size=1, max_size=10)):
        body[place] = data.draw(st.sampled_from((0, 1, 0x7F, 0x80, 0xFF)) | st.integers(0, 255))
    _image_or_named_error(bytes(body))
