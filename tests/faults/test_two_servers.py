"""The second service on a data directory does not start, and the first one does not notice."""

from pathlib import Path

import pytest

from .conftest import Service, begin, check_is_clean, command, n_observations, observation, wait_until

pytestmark = pytest.mark.slow


def test_the_second_refuses_before_it_listens(data_dir: Path, tmp_path: Path) -> None:
    with Service(data_dir) as service:
        session_id = begin(service)
        ran = command("serve", "--port", 0, "--data-dir", data_dir)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err.splitlines()[-1].startswith(
            f"deepsimbad: data_dir_in_use: another service (process {service.pid}, listening on 127.0.0.1:"
        )
        assert "Uvicorn running" not in ran.err
        (data_dir / "service.lock").unlink()  # it only tells whose the folder is
        assert "data_dir_in_use" in command("serve", "--port", 0, "--data-dir", data_dir).err.splitlines()[-1]
        assert service.answer_to(**observation(session_id, 3))["n_observations"] == 4
        assert command("backup", tmp_path / "b.tar", "--data-dir", data_dir).code == 0
        assert "another service" in command("restore", tmp_path / "b.tar", "--data-dir", data_dir).line
        assert command("info", "loop", "--data-dir", data_dir).code == 0, "a command is no service"
        service.kill()
    with Service(data_dir) as service:
        assert n_observations(service, session_id) == 4
    check_is_clean(data_dir)


@pytest.mark.parametrize("name", ["sessions.sqlite", "sessions.sqlite-wal"])
def test_nothing_is_acknowledged_into_a_file_that_is_gone(data_dir: Path, name: str) -> None:
    with Service(data_dir) as service:
        session_id = begin(service)
        (data_dir / name).unlink()
        for request in (
            observation(session_id, 3),
            {"method": "POST", "path": "/v1/domains/loop/sessions", "json": {}},
        ):
            refusal = service.refusal_of(code="damaged_file", **request)
            assert f"{name} was removed under the running service" in refusal["detail"]
        wait_until(lambda: service.client.get("/readyz").status_code == 503)  # it looks once a second
        assert service.version_by("loop") == 2
