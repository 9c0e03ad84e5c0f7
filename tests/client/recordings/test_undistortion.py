import logging

import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import nclt
from deepsimbad_client.recordings.nclt import find_undistortion_file, load_undistortion, parse_undistortion

WIDTH, HEIGHT = 6, 4


def pixel_lines(dv=0.25, du=0.5):
    return [f"{row} {col} {row + dv:.6f} {col + du:.6f}" for row in range(HEIGHT) for col in range(WIDTH)]


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "U2D_Cam5_6X4.txt"
    path.write_text("\n".join(["image size (6, 4)", *pixel_lines()]) + "\n")
    return path


@pytest.mark.parametrize("header", ["6,4", "6, 4\r", "Cam1: 6, 4", "Cam5 width=6, height=4", "Ladybug3 camera 5", ""])
def test_columns_are_row_col_v_u_in_any_order_under_headers_of_any_wording(table, header):
    table.write_text("\n".join([header, *pixel_lines()[::-1]]))
    parsed = parse_undistortion(table)
    assert parsed.size == (WIDTH, HEIGHT)
    assert (parsed.u.dtype, parsed.v.dtype) == (np.float32, np.float32)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    np.testing.assert_allclose(parsed.v, rows + 0.25)
    np.testing.assert_allclose(parsed.u, columns + 0.5)


def test_a_picture_is_looked_up_with_interpolation(table):
    stored = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stored[1, 2] = 200
    seen = parse_undistortion(table).apply(stored)[:, :, 0]
    # Pixel (row, col) looks at (row + 1/4, col + 1/2): bilinear weights of the one bright pixel.
    assert seen[1, 2] == pytest.approx(200 * 0.75 * 0.5, abs=2)
    assert seen[0, 1] == pytest.approx(200 * 0.25 * 0.5, abs=2)
    assert seen[3].max() == 0


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["5,4", *pixel_lines()], "announces .'5,4'"),
        (["6,4", *pixel_lines()[:-1], pixel_lines()[0]], "not the whole"),
        (["Cam1: 6, 4", *pixel_lines()[:-WIDTH]], "18 pixels reaching 6 x 3"),
        (["6,4", "0 0 1"], "four numbers"),
        ([""], "four numbers"),
        (["6,4", "0 0 nan 1"], "four numbers"),
        (["6,4", "a b c d"], "not an undistortion table"),
        (["6,4", "-1 0 1 1"], "four numbers"),
    ],
)
def test_what_is_no_complete_table_is_refused(table, lines, message):
    table.write_text("\n".join(lines))
    with pytest.raises(SourceError, match=message):
        parse_undistortion(table)


def test_a_table_is_parsed_once_and_again_when_the_file_or_the_cache_changes(table, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    parsed = []

    def counting(path):
        parsed.append(path)
        return parse_undistortion(path)

    monkeypatch.setattr(nclt, "parse_undistortion", counting)
    first, second = load_undistortion(table), load_undistortion(table)
    assert len(parsed) == 1
    np.testing.assert_array_equal(first.u, second.u)
    np.testing.assert_array_equal(first.v, second.v)
    (cached,) = (tmp_path / "xdg" / "deep-simbad").iterdir()
    assert cached.suffix == ".npz", "nothing half-written stays behind"
    cached.write_bytes(cached.read_bytes()[:50])
    (tmp_path / "file").write_text("in the way")
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(load_undistortion(table).u, first.u)
        assert load_undistortion(table, tmp_path / "file").size == (6, 4)
    assert len(parsed) == 3
    assert "damaged" in caplog.text
    assert "cannot keep" in caplog.text
    table.write_text("\n".join(["6,4", *pixel_lines(du=0.125)]))
    np.testing.assert_allclose(load_undistortion(table).u[0, 0], 0.125)
    assert len(parsed) == 4


def test_the_cameras_own_table_is_found(table, tmp_path):
    assert find_undistortion_file(tmp_path, 5) == table
    assert find_undistortion_file(table, 3) == table
    with pytest.raises(SourceError, match="U2D_Cam3_"):
        find_undistortion_file(tmp_path, 3)
    with pytest.raises(SourceError, match="nowhere"):
        load_undistortion(tmp_path / "nowhere.txt", tmp_path)
