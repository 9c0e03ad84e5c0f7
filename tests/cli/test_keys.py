"""`deepsimbad keys`."""

import json
import re

import pytest

KEY = re.compile(r"dsk_([0-9a-f]{12})_[A-Za-z0-9_-]{43}")


def test_a_key_is_printed_alone(deepsimbad, tmp_path):
    ran = deepsimbad("keys", "create", "--scope", "admin", "--name", "the operator", "--data-dir", tmp_path / "d")
    match = KEY.fullmatch(ran.out.strip())
    assert (ran.code, ran.out) == (0, f"{match[0]}\n")
    assert "first" in ran.err
    assert match[0] not in ran.err
    limits = ("--expires-days", "2", "--domain", "campus", "--domain", "yard")
    second = deepsimbad("keys", "create", "--scope", "localize", *limits, "--data-dir", tmp_path / "d")
    assert "first" not in second.err
    keys = json.loads(deepsimbad("keys", "list", "--json", "--data-dir", tmp_path / "d").out)
    assert [[key[name] for name in ("key_id", "name", "scope", "state", "domains")] for key in keys] == [
        [match[1], "the operator", "admin", "usable", None],
        [KEY.fullmatch(second.out.strip())[1], "", "localize", "usable", ["campus", "yard"]],
    ]
    assert keys[0]["expires_at"] is None
    assert keys[1]["expires_at"] > keys[1]["created_at"]


def test_a_revoked_key_is_listed_as_such(deepsimbad):
    first = KEY.fullmatch(deepsimbad("keys", "create", "--scope", "admin").out.strip())
    second = KEY.fullmatch(deepsimbad("keys", "create", "--scope", "admin", "--name", "[red]x").out.strip())
    ran = deepsimbad("keys", "revoke", first[1])
    assert (ran.code, ran.out) == (0, "")
    assert "stays closed" not in ran.err
    ran = deepsimbad("keys", "revoke", second[0])
    assert ran.code == 0, "a whole key names itself"
    assert "stays closed" in ran.err
    assert second[0] not in ran.err
    keys = json.loads(deepsimbad("keys", "list", "--json").out)
    assert [key["state"] for key in keys] == ["revoked", "revoked"]
    table = deepsimbad("keys", "list").out
    assert first[1] in table
    assert "[red]x" in table
    assert first[0] not in table


def test_a_script_is_told_what_was_revoked(deepsimbad):
    key = KEY.fullmatch(deepsimbad("keys", "create", "--scope", "admin", "--name", "old").out.strip())
    ran = deepsimbad("keys", "revoke", key[1], "--json")
    assert ran.code == 0
    document = json.loads(ran.out)
    assert (document["key_id"], document["name"], document["state"]) == (key[1], "old", "revoked")
    assert document["revoked_at"]
    assert [document] == json.loads(deepsimbad("keys", "list", "--json").out)
    assert "stays closed" in ran.err


def test_mistakes_are_named_and_change_nothing(deepsimbad, tmp_path):
    admin, localize = ("create", "--scope", "admin"), ("create", "--scope", "localize")
    for arguments in (("create",), ("create", "--scope", "root"), (*admin, "--expires-days", "0")):
        assert deepsimbad("keys", *arguments).code == 2
    for arguments in (
        ("revoke", "0123456789ab"),
        *((*admin, *option) for option in (("--name", "a\nb"), ("--domain", "campus"), ("--expires-days", "1e300"))),
        (*localize, "--domain", "../campus"),
    ):
        assert deepsimbad("keys", *arguments).line
    assert json.loads(deepsimbad("keys", "list", "--json").out) == []


@pytest.mark.parametrize("command", [("list",), ("list", "--json"), ("revoke", "0123456789ab")])
def test_a_question_makes_no_folder(deepsimbad, tmp_path, command):
    ran = deepsimbad("keys", *command, "--data-dir", tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    assert "name their folder with --data-dir" in ran.err  # a mistyped folder would look like one without keys
