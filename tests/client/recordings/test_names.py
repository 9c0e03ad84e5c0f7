import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepsimbad_client.recordings.names import Finder, in_order, times_of


@pytest.mark.parametrize(
    "ordered",
    [
        ["1.png", "02.png", "2.png", "10.png", "a9.png", "a10b1.png", "a10b2.png"],
        ["1305031102.175.png", "1305031103.png", "1305031103.25.png", "1305031103.5.png", "cover.png"],
        ["left_1305031103.25.png", "left_1305031103.5.png", "left_1305031104.0.png"],
        ["-1.5.png", "-0.25.png", "0.125.png", ".5.png"],
        ["shot 1.9.png", "shot 1.10.png", "shot 1.11.png"],
        ["2012.01.8.png", "2012.01.22.png"],
        ["0009.png", "000a.png", "000f.png", "0010.png"],
        ["9,75.png", "12,25.png", "12,5.png", "x_12,75.png"],
    ],
)
def test_numbers_in_names_count_as_numbers(ordered):
    assert in_order(sorted(ordered)) == in_order(ordered[::-1]) == ordered


@given(st.lists(st.integers(0, 99_999), unique=True, min_size=1))
def test_padded_names_sort_as_usual_and_bare_ones_by_number(numbers):
    padded = [f"frame{number:05d}.png" for number in numbers]
    assert in_order(padded) == sorted(padded)
    bare = [f"{number}.png" for number in numbers]
    assert in_order(bare) == [f"{number}.png" for number in sorted(numbers)]


@given(st.lists(st.decimals(0, 2_000_000_000, places=4), unique=True, min_size=1))
def test_times_as_scripts_write_them_are_in_the_order_of_time(times):
    names = {f"{float(time)!r}.png": time for time in times if "e" not in repr(float(time))}
    assert in_order(list(names)) == sorted(names, key=names.get)


def test_names_that_are_times_tell_them():
    in_us = 1_305_031_103_250_000
    for name in (
        "1305031103.25.png",
        "1305031103,25.png",
        "1305031103250.jpg",
        "left_1305031103250000.tiff",
        "f7-1305031103250000000",
        "1305031103_250000000.png",
    ):
        assert times_of([name]) == [in_us]
    for names in (["7.png"], ["1305031103.25.png", "1305031103250.png"], ["1305031103.png", "cover.png"]):
        assert times_of(names) is None


@pytest.mark.parametrize(
    ("spelling", "meant"),
    [
        ("images\\00000.PNG", "00000.png"),
        ("./x/00000.png", "00000.png"),
        ("00000", "00000.png"),
        ("00000.jpg", "00000.png"),
        ("0", "00000.png"),
        ("img_7.jpg", "IMG_7.JPG"),
        ("1305031103.25", "1305031103.25.png"),
        ("1305031103.2500", "1305031103.25.png"),
        ("Ba\u0308ume.png", "B\u00e4ume.png"),
        ("a.png", "a.png"),
        ("A.png", "A.png"),
        ("A.jpg", "A.png"),
        ("00001.png", None),
        ("", None),
    ],
)
def test_a_spelling_finds_its_file(spelling, meant):
    assert (
        Finder(["00000.png", "IMG_7.JPG", "1305031103.25.png", "B\u00e4ume.png", "a.png", "A.png"]).find(spelling)
        == meant
    )


def test_what_may_mean_two_files_means_none():
    assert Finder(["7.png", "7.jpg"]).find("7") is None
    assert Finder(["7.png", "7.jpg"]).find("7.jpg") == "7.jpg"
