"""A service that asks for keys, as a robot, an administrator and a stranger meet it."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope
from deepsimbad_client import Client, errors
from deepsimbad_client.commands.group import run
from deepsimbad_client.http.jobs import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from .conftest import serving


class Locked(NamedTuple):
    """A service and keys of it."""

    url: str
    admin: str
    robot: str
    other_robot: str


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory, encodings: Path) -> Iterator[Locked]:
    data_dir = tmp_path_factory.mktemp("locked")
    with Catalog.open(data_dir) as catalog:
        scopes = (KeyScope.ADMIN, KeyScope.LOCALIZE, KeyScope.LOCALIZE)
        keys = [catalog.create_key(scope, "", None)[1].text for scope in scopes]
    with serving(data_dir) as url:
        with Client(url, keys[0]) as client:
            client.admin.put_domain("d", {"kind": "feature_l2", "extractor": "none"})
            for name in ("landmarks", "summer"):
                upload(client, open_source(str(encodings / f"{name}.npy")), "d", name)
            remap(client, "d", "summer", landmark_traverse="landmarks", n_landmarks=50, training_episodes=0)
        yield Locked(url, *keys)


def test_who_may_do_what(locked: Locked, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DEEPSIMBAD_API_KEY", raising=False)
    with Client(locked.url) as stranger:
        assert stranger.ready().status == "ready"
        with pytest.raises(errors.UnauthorizedError, match=r"keys create --scope localize\|admin"):
            stranger.domains()
    with Client(locked.url, "dsk_000000000000_" + "a" * 43) as guesser, pytest.raises(errors.UnauthorizedError):
        guesser.domains()
    with Client(locked.url, locked.robot) as robot:
        assert [domain.name for domain in robot.domains()] == ["d"]
        with robot.session("d") as session:
            session.observe(ranked_landmarks=[1, 2])
        with pytest.raises(errors.ForbiddenError, match="keys create --scope admin`") as forbidden:
            robot.admin.sessions()
    assert forbidden.value.problem["needed"] == "admin"
    with Client(locked.url, locked.admin) as administrator:
        assert administrator.admin.maps("d")[0].state == "active"
        assert administrator.admin.sessions() == ()


def test_two_robots_that_choose_one_word_have_a_session_each(locked: Locked) -> None:
    begun = []
    for key in (locked.robot, locked.other_robot, locked.robot):
        with Client(locked.url, key) as robot:
            begun.append(robot.session("d", idempotency_key="start", keep=True).session_id)
    assert begun[0] == begun[2] != begun[1]
    with Client(locked.url, locked.admin) as administrator:
        assert {session.session_id for session in administrator.admin.sessions("d")} == set(begun)


def test_the_command_line_says_what_to_do(
    locked: Locked, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DEEPSIMBAD_URL", locked.url)
    for key, code in (("", "unauthorized"), (locked.robot, "forbidden")):
        monkeypatch.setenv("DEEPSIMBAD_API_KEY", key)
        assert run(["jobs"]) == 1
        told = capsys.readouterr().err
        assert told.startswith(f"deepsimbad-client: {code}: ")
        assert "deepsimbad keys create --scope" in told
        assert "$DEEPSIMBAD_API_KEY" in told
        assert told.count("\n") == 1
        assert locked.robot not in told
    assert run(["jobs", "--api-key", locked.admin]) == 0
    assert "succeeded" in capsys.readouterr().out
