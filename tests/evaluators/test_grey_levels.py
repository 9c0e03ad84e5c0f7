"""Grey levels: cameras of any number of bits show one picture, and a view is shown as its map's were."""

import cv2
import numpy as np
import pytest

from deepsimbad.evaluators.grey_levels import holds_few_greys, levels_in, measured_levels, scaled_picture
from deepsimbad.evaluators.image import decode_image
from deepsimbad_client.recordings.sources import open_source

LIMIT = 1_000_000


def picture(seed):
    """[120, 160] uint8."""
    random = np.random.default_rng(seed)
    coarse = random.integers(20, 236, (6, 8), np.uint8)
    grains = random.normal(0, 3, (120, 160))
    return np.clip(cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC) + grains, 0, 255).astype(np.uint8)


WHOLE_DEPTHS = {"8": 1, "10": 4, "12": 16, "14": 64, "16": 257}  # bits -> counts of a grey level
STRETCHED = {
    "thermal": lambda grey: 7500 + grey * (600 / 255),
    "12 bits on a pedestal": lambda grey: 2048 + grey * 8,
    "dark 12 bits": lambda grey: 70 + grey * 5,
    "16 bits, a corner of them": lambda grey: 50_000 + grey * 40,
}


def make_recording(folder, deepen, n=6, form="png"):
    folder.mkdir()
    for number in range(n):
        cv2.imwrite(str(folder / f"{number}.{form}"), deepen(picture(number).astype(float)).astype(np.uint16))
    return open_source(str(folder))


def posted_picture(recording, number, size=None):
    return decode_image(recording.image(recording.frames[number], size).body, LIMIT)[..., 1]


@pytest.mark.parametrize("form", ["png", "tiff", "pgm"])
@pytest.mark.parametrize("bits", WHOLE_DEPTHS)
def test_a_camera_that_fills_the_low_bits_shows_its_own_eight(tmp_path, bits, form):
    recording = make_recording(tmp_path / "drive", lambda grey: grey * WHOLE_DEPTHS[bits], form=form)
    assert recording.grey_levels == (0, 2 ** int(bits) - 1)
    for number in range(6):
        np.testing.assert_array_equal(posted_picture(recording, number), picture(number))
    assert any("shown as 8" in remark for remark in recording.remarks)


@pytest.mark.parametrize("kind", STRETCHED)
def test_a_part_of_the_range_is_stretched_over_the_whole_recording(tmp_path, kind):
    recording = make_recording(tmp_path / "drive", STRETCHED[kind])
    for number in range(6):
        grey = posted_picture(recording, number).astype(float)
        assert np.corrcoef(grey.ravel(), picture(number).ravel())[0, 1] > 0.99
        assert 0.8 < grey.std() / picture(number).std() < 1.3
        assert (grey == 255).mean() + (grey == 0).mean() < 0.01


def test_a_lens_cap_at_either_end_tells_no_levels(tmp_path):
    folder = tmp_path / "drive"
    make_recording(folder, lambda grey: grey * 16, n=30)
    noise = np.random.default_rng(0)
    for number in (0, 1, 2, 28, 29):
        cv2.imwrite(str(folder / f"{number}.png"), noise.integers(60, 70, (120, 160), np.uint16))
    recording = open_source(str(folder))
    assert recording.grey_levels == (0, 4095)
    assert posted_picture(recording, 0).std() < 1
    assert posted_picture(recording, 29).max() < 10
    assert open_source(f"{folder}#10:15").grey_levels == (0, 4095), "a slice is shown as the whole"


def test_noise_is_not_stretched_to_a_picture():
    noise = np.random.default_rng(0).integers(200, 250, (40, 60, 3), np.uint16)
    assert np.ptp(scaled_picture(noise, measured_levels([noise]))) < 52


def test_images_of_eight_bits_have_no_levels(tmp_path):
    for number in range(5):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(number))
    recording = open_source(str(tmp_path))
    assert recording.grey_levels is None
    np.testing.assert_array_equal(posted_picture(recording, 0), picture(0))


def test_few_greys_are_noticed():
    grey = picture(0)[..., None].repeat(3, axis=2)
    assert not holds_few_greys(grey)
    assert not holds_few_greys(grey // 8)
    assert holds_few_greys(grey >> 6)
    assert holds_few_greys(grey // 50 + 90)


def test_levels_of_a_map_come_with_its_landmarks():
    assert levels_in({"grey_levels": np.array([3, 700])}) == (3, 700)
    assert levels_in({}) is None
