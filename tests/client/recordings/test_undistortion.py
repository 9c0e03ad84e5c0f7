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
    columns, rows = read_undistortion(table, 5)
    assert rows.dtype == np.float32
    expected_rows, expected_columns = np.mgrid[:HEIGHT, :WIDTH]
    np.testing.assert_allclose(rows, expected_rows + 0.25)
    np.testing.assert_allclose(columns, expected_columns + 0.5)


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
    assert np.array_equal(read_undistortion(tmp_path, 5), read_undistortion(table, 3))
    for path in (tmp_path, tmp_path / "nowhere.txt"):
        with pytest.raises(SourceError, match=r"U2D_Cam3_|nowhere"):
            read_undistortion(path, 3)
