"""`deepsimbad backup` and `restore`."""

import hashlib
import json

import pytest

READY = ("--evaluator", "feature_l2:none", "--n-landmarks", 20)


@pytest.fixture
def mapped(deepsimbad, drives, tmp_path):
    """A data directory with one mapped domain."""
    made = deepsimbad(
        "map", "route", "--landmarks", drives / "landmarks.npy", "--training", drives / "summer.npy", *READY
    )
    assert made.code == 0, made.err
    return tmp_path / "deepsimbad-data"


def test_there_and_back(deepsimbad, mapped, tmp_path):
    ran = deepsimbad("backup", "b.tar", "--json")
    assert (ran.code, ran.err) == (0, "")
    report = json.loads(ran.out)
    assert (report["n_domains"], report["n_maps"], report["n_traverses"]) == (1, 1, 2)
    assert report["bytes"] == (tmp_path / "b.tar").stat().st_size
    assert report["sha256"] == hashlib.sha256((tmp_path / "b.tar").read_bytes()).hexdigest()
    before = json.loads(deepsimbad("info", "route", "--json").out)
    ran = deepsimbad("restore", "b.tar", "--data-dir", "there", "--json")
    assert (ran.code, ran.err) == (0, "")
    assert json.loads(ran.out)["n_files"] == 4
    assert json.loads(deepsimbad("info", "route", "--json", "--data-dir", "there").out) == before


def test_for_people_it_is_one_line_on_standard_error(deepsimbad, mapped):
    ran = deepsimbad("backup", "b.tar")
    assert (ran.code, ran.out, len(ran.err.splitlines())) == (0, "", 1)
    assert "1 domains, 1 maps, 2 traverses" in ran.err
    ran = deepsimbad("restore", "b.tar", "--data-dir", "there")
    assert (ran.code, ran.out, len(ran.err.splitlines())) == (0, "", 1)


def test_errors_are_one_line(deepsimbad, mapped, tmp_path):
    assert deepsimbad("backup", "b.tar").code == 0
    for arguments, said in (
        (("backup", "b.tar"), "never replaces a file"),
        (("backup", "c.tar", "--data-dir", "nowhere"), "there are no domains in nowhere"),
        (("backup", "no/folder.tar"), "there is no folder no"),
        (("restore", "b.tar"), "is not empty"),
        (("restore", "gone.tar", "--data-dir", "there"), "No such file"),
        (("restore", tmp_path, "--data-dir", "there"), "directory"),
    ):
        ran = deepsimbad(*arguments)
        assert (ran.code, ran.out, len(ran.err.splitlines())) == (1, "", 1), arguments
        assert said in ran.err
    assert not (tmp_path / "there").exists()
    assert not (tmp_path / "nowhere").exists()
