"""`deepsimbad serve`: ready, stopped, refused."""

import json
import signal
import socket
import stat
import time
import urllib.error
import urllib.request

import httpx2
import pytest

pytestmark = pytest.mark.slow


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_until_ready(port, running):
    give_up = time.monotonic() + 300
    while time.monotonic() < give_up:
        assert running.poll() is None, running.communicate()
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=60) as answer:
                return answer.status
        except urllib.error.URLError:
            time.sleep(0.05)
    raise AssertionError("the service did not become ready")


@pytest.mark.parametrize(("by", "code", "is_made"), [(signal.SIGTERM, 0, False), (signal.SIGINT, 130, True)])
def test_it_serves_until_it_is_stopped(deepsimbad, process, tmp_path, by, code, is_made):
    """In a directory that it makes, told by flags; in one that was made before, told by the environment."""
    port, folder = free_port(), tmp_path / "here"
    if is_made:
        for _ in range(2):
            assert deepsimbad("init", "--data-dir", folder).code == 0
        variables = {"DEEPSIMBAD_PORT": str(port), "DEEPSIMBAD_HOST": "127.0.0.1", "DEEPSIMBAD_DATA_DIR": str(folder)}
        running = process("serve", **variables)
    else:
        running = process("serve", "--create", "--port", port, "--data-dir", folder)
    assert wait_until_ready(port, running) == 200
    running.send_signal(by)
    out, err = running.communicate(timeout=60)
    assert running.returncode == code, err
    assert out == "", "logs go to standard error"
    (ready,) = (json.loads(line) for line in err.splitlines() if '"message": "ready"' in line)
    assert ready["console"] == f"{ready['url']}/console"
    assert (folder / "catalog.sqlite").exists()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.usefixtures("_logging_as_before")
@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (("--port", 0), "invalid_settings", "there is no data directory deepsimbad-data"),
        (("--host", "0.0.0.0", "--port", 0), "invalid_settings", "DEEPSIMBAD_ALLOW_OPEN"),
        (("--config", "bad.toml"), "invalid_settings", "there is no setting 'data_dri'"),
        (
            ("--create", "--data-dir", "here", "--port", "taken"),
            "unavailable",
            "address already in use; --host and",
        ),
    ],
)
def test_a_start_that_fails_is_told_in_one_record_and_one_line(deepsimbad, tmp_path, arguments, code, reason):
    (tmp_path / "bad.toml").write_text("data_dri = 'there'")
    with socket.create_server(("127.0.0.1", 0)) as server:
        ran = deepsimbad("serve", *(server.getsockname()[1] if word == "taken" else word for word in arguments))
    assert (ran.code, ran.out) == (1, "")
    *_, record, line = ran.err.splitlines()
    logged = json.loads(record)
    assert (logged["level"], logged["message"], logged["code"]) == ("ERROR", "cannot start", code)
    assert reason in logged["why"]
    assert line == f"deepsimbad: {code}: {' '.join(logged['why'].split())}"
    assert {path.name for path in tmp_path.iterdir()} <= {"bad.toml", "here"}


def test_with_a_key_other_machines_may_reach_it(deepsimbad, process, tmp_path):
    key = deepsimbad("keys", "create", "--scope", "localize", "--data-dir", tmp_path / "keyed").out.strip()
    port = free_port()
    running = process("serve", "--host", "0.0.0.0", "--port", port, "--data-dir", tmp_path / "keyed")
    assert wait_until_ready(port, running) == 200
    place = f"http://127.0.0.1:{port}/v1/domains"
    assert httpx2.get(place).status_code == 401
    assert httpx2.get(place, headers={"Authorization": f"Bearer {key}"}).status_code == 200
    running.terminate()
    _, err = running.communicate(timeout=60)
    assert "asks for keys" in err
    assert "runs open" not in err
    assert key not in err
