from pathlib import Path

import pytest

from deepsimbad.errors import InvalidInputError
from deepsimbad.store import layout

BAD_NAMES = ["", ".", "..", "../x", "a/b", "a\\b", "-a", "_a", ".a", "a b", "a\n", "a\0", "é", "\ud800", "a" * 65]


@pytest.mark.parametrize("name", ["a", "9", "Summer-2012_01.08", "a" * 64, "a..b"])
def test_good_names_stay_inside_the_data_directory(name: str, tmp_path: Path) -> None:
    path = layout.traverse_path(tmp_path, name, name)
    assert path.resolve().parent == (tmp_path / "domains" / name / "traverses").resolve()


@pytest.mark.parametrize("name", BAD_NAMES)
def test_bad_names_never_become_paths(name: str, tmp_path: Path) -> None:
    for path_of in (
        lambda: layout.domain_folder(tmp_path, name),
        lambda: layout.traverse_path(tmp_path, "campus", name),
        lambda: layout.traverse_path(tmp_path, name, "summer"),
        lambda: layout.map_path(tmp_path, name, 1),
    ):
        with pytest.raises(InvalidInputError):
            path_of()


def test_map_files_are_named_by_version(tmp_path: Path) -> None:
    assert layout.map_path(tmp_path, "campus", 7) == tmp_path / "domains/campus/maps/000007.sqlite"
    assert layout.map_path(tmp_path, "campus", 1_234_567).name == "1234567.sqlite"
    assert layout.building_path(tmp_path, "campus", 7).name == "000007.building"
    for version in (0, -1, 2**60):
        with pytest.raises(InvalidInputError):
            layout.map_path(tmp_path, "campus", version)
