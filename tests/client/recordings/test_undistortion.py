import numpy as np
import pytest

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.nclt import read_undistortion

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
    parsed = read_undistortion(table, 5)
    assert parsed.size == (WIDTH, HEIGHT)
    assert (parsed.u.dtype, parsed.v.dtype) == (np.float32, np.float32)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    np.testing.assert_allclose(parsed.v, rows + 0.25)
    np.testing.assert_allclose(parsed.u, columns + 0.5)


def test_a_picture_is_looked_up_with_interpolation(table):
    stored = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stored[1, 2] = 200
    pixels = read_undistortion(table, 5).apply(stored)[:, :, 0]
    # Pixel (row, col) looks at (row + 1/4, col + 1/2): bilinear weights of the one bright pixel.
    assert pixels[1, 2] == pytest.approx(200 * 0.75 * 0.5, abs=2)
    assert pixels[0, 1] == pytest.approx(200 * 0.25 * 0.5, abs=2)
    assert pixels[3].max() == 0


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["6,4", *pixel_lines()[:-1], pixel_lines()[0]], "not the whole"),
        (["6, 4", *pixel_lines()[:-1]], "23 pixels are not the whole of a table of 6 x 4"),
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
        read_undistortion(table, 5)


def test_the_cameras_own_table_is_found(table, tmp_path):
    assert read_undistortion(tmp_path, 5).size == read_undistortion(table, 3).size
    for path in (tmp_path, tmp_path / "nowhere.txt"):
        with pytest.raises(SourceError, match=r"U2D_Cam3_|nowhere"):
            read_undistortion(path, 3)
