"""`deepsimbad check`."""

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


def test_all_is_well(deepsimbad, mapped):
    ran = deepsimbad("check")
    assert (ran.code, ran.out) == (0, "")
    assert ran.err == "4 files read, 0 problems\n"
    ran = deepsimbad("check", "--json")
    assert (ran.code, ran.err) == (0, "")
    assert json.loads(ran.out) == {"ok": True, "n_files": 4, "damaged": []}


def test_damage_is_one_line_and_exit_code_1(deepsimbad, mapped):
    path = mapped / "domains" / "route" / "maps" / "000001.sqlite"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    (mapped / "domains" / "route" / "traverses" / "half.new").touch()  # what a crash leaves is no damage
    ran = deepsimbad("check")
    assert ran.code == 1
    (damaged,) = ran.out.splitlines()
    assert damaged.startswith("damaged: domains/route/maps/000001.sqlite: ")
    ran = deepsimbad("check", "--json")
    assert ran.code == 1
    assert json.loads(ran.out)["ok"] is False
    path.unlink()
    assert deepsimbad("check").code == 1


def test_a_missing_catalog_is_damage_and_nothing_at_all_an_error(deepsimbad, mapped, tmp_path):
    (mapped / "catalog.sqlite").unlink()
    ran = deepsimbad("check")
    assert ran.code == 1
    assert ran.out.splitlines()[0].startswith("damaged: catalog.sqlite: ")
    ran = deepsimbad("check", "--data-dir", "nowhere")
    assert (ran.code, ran.out, len(ran.err.splitlines())) == (1, "", 1)
    assert "nothing to check in nowhere" in ran.err
    assert not (tmp_path / "nowhere").exists()
