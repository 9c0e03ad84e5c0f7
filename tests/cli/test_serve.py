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
    give_up = time.monotonic() + 60
    while time.monotonic() < give_up:
        assert running.poll() is None, running.communicate()
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=60) as answer:
                return answer.status
        except urllib.error.URLError:
            time.sleep(0.05)
    raise AssertionError("the service did not become ready")


def assert_it_cannot_start(err, code, why):
    """One record for what reads the log, then the line that every named error is."""
    *_, record, line = err.splitlines()
    logged = json.loads(record)
    assert (logged["level"], logged["message"], logged["code"]) == ("ERROR", "cannot start", code)
    assert why in logged["why"]
    assert line == f"deepsimbad: {code}: {' '.join(logged['why'].split())}"


@pytest.mark.parametrize(("by", "code", "is_made"), [(signal.SIGTERM, 0, False), (signal.SIGINT, 130, True)])
def test_it_serves_until_it_is_stopped(deepsimbad, process, tmp_path, by, code, is_made):
    """In a directory that it makes, told by flags; in one that was made before, told by the environment."""
    port, folder = free_port(), tmp_path / "here"
    if is_made:
        for _ in range(2):
            assert deepsimbad("init", "--data-dir", folder).code == 0
        named = {"DEEPSIMBAD_PORT": str(port), "DEEPSIMBAD_HOST": "127.0.0.1", "DEEPSIMBAD_DATA_DIR": str(folder)}
        running = process("serve", **named)
    else:
        running = process("serve", "--create", "--port", port, "--data-dir", folder)
    assert wait_until_ready(port, running) == 200
    running.send_signal(by)
    out, err = running.communicate(timeout=60)
    assert running.returncode == code, err
    assert out == "", "logs go to standard error"
    assert (folder / "catalog.sqlite").exists()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_data_directory_must_be_there(process, tmp_path):
    running = process("serve", "--port", 0)
    _, err = running.communicate(timeout=60)
    assert running.returncode == 1
    assert_it_cannot_start(err, "invalid_settings", "there is no data directory deepsimbad-data")
    assert list(tmp_path.iterdir()) == []


def test_other_machines_are_refused_while_there_are_no_keys(process):
    running = process("serve", "--host", "0.0.0.0", "--port", free_port())
    out, err = running.communicate(timeout=60)
    assert (running.returncode, out) == (1, "")
    assert_it_cannot_start(err, "invalid_settings", "DEEPSIMBAD_ALLOW_OPEN")
    assert len(err.splitlines()) == 2


def test_settings_that_cannot_be_used_are_logged_too(process, tmp_path):
    (tmp_path / "bad.toml").write_text("data_dri = 'there'")
    running = process("serve", "--config", "bad.toml")
    out, err = running.communicate(timeout=60)
    assert (running.returncode, out) == (1, "")
    assert_it_cannot_start(err, "invalid_settings", "there is no setting 'data_dri'")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.toml"]


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


def test_a_port_that_is_taken_is_an_error(process):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        running = process("serve", "--create", "--port", taken.getsockname()[1])
        _, err = running.communicate(timeout=60)
    assert running.returncode == 1
    assert "address already in use" in err.lower()
    assert_it_cannot_start(err, "unavailable", "cannot listen on")
