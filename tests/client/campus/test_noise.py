import numpy as np

from deepsimbad_client.campus.noise import smooth_line, stream, tile_noise


def test_streams_differ_by_seed_name_and_block_and_repeat_themselves():
    draws = {stream(*key).integers(0, 1 << 60) for key in ((0, "a", 0), (1, "a", 0), (0, "b", 0), (0, "a", 1))}
    assert len(draws) == 4
    assert stream(3, "x", 2).random() == stream(3, "x", 2).random()


def test_a_longer_line_begins_like_a_shorter_one_and_passes_through_its_knots():
    long = smooth_line(stream(0, "line"), np.linspace(0, 50, 501))
    short = smooth_line(stream(0, "line"), np.linspace(0, 20, 201))
    np.testing.assert_array_equal(long[:201], short)
    knots = stream(0, "line").standard_normal(51)
    np.testing.assert_allclose(long[::10], knots)
    assert np.abs(np.diff(long)).max() < 0.6  # smooth: knots a whole step apart differ by up to 4


def test_tiles_have_no_seam():
    tile = tile_noise(np.random.default_rng(0), (128, 256), (4, 8), 4)
    assert tile.shape == (128, 256)
    inside = np.abs(np.diff(tile, axis=0)).max(), np.abs(np.diff(tile, axis=1)).max()
    assert np.abs(tile[0] - tile[-1]).max() <= 1.05 * inside[0]
    assert np.abs(tile[:, 0] - tile[:, -1]).max() <= 1.05 * inside[1]
    assert abs(float(tile.std()) - 1) < 1e-3
