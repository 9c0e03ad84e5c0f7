"""What must hold still while the house is rebuilt, from outside: bytes of answers, maps, beliefs and texts.

Run with GOLDEN_UPDATE=1 to write the files anew after a difference that is meant. What is counted, named or listed is
the same on every processor; numbers that were added up differ in their last digits, and are compared without those.
"""

import hashlib
import io
import json
import os
import re
import sqlite3
import time
from contextlib import closing
from importlib.metadata import version
from pathlib import Path

import httpx2
import numpy as np
import pytest
from click import Argument, Context, Group
from click.testing import CliRunner

from deepsimbad.cli import deepsimbad as commands
from deepsimbad.cli import run
from deepsimbad_client.commands import cli
from deepsimbad_client.http.local_server import LocalServer

GOLDEN = Path(__file__).parent
COMMANDS = """init, serve, keys, keys create, keys list, keys revoke, map, localize, try, info, delete-domain, settings,
experiment, experiment vpr, experiment nbv, experiment calibration, experiment paper, backup, restore, export, import,
check, weights, weights list, weights pull, weights verify, ray, ray map""".replace("\n", " ").split(", ")
CLIENT_COMMANDS = """activate campus delete-domain delete-map delete-session delete-traverse domains download jobs
localize maps remap replay rollback sessions traverses upload watch""".split()  # noqa: SIM905 - as one writes it


def deepsimbad(*arguments):
    assert run([str(argument) for argument in arguments]) == 0


def check(name, value, **tolerance):
    """Compare a value with the golden file of that name, real numbers within pytest.approx's `tolerance`."""
    path = GOLDEN / f"{name}.json"
    text = json.dumps(value, indent=1, sort_keys=True) + "\n"
    if os.environ.get("GOLDEN_UPDATE"):
        path.write_text(text)
    compare(json.loads(text), json.loads(path.read_text()), path.name, tolerance or {"rel": 1e-4, "abs": 1e-7})


def compare(value, golden, path, tolerance):
    """Assert that a value equals the golden one, real numbers within a tolerance."""
    assert type(value) is type(golden), path
    if isinstance(value, dict):
        assert value.keys() == golden.keys(), path
        for name in value:
            compare(value[name], golden[name], f"{path} {name}", tolerance)
    elif isinstance(value, list):
        assert len(value) == len(golden), path
        for place, (item, golden_item) in enumerate(zip(value, golden, strict=True)):
            compare(item, golden_item, f"{path} {place}", tolerance)
    elif isinstance(value, float):
        assert value == pytest.approx(golden, **tolerance), path
    else:
        assert value == golden, path


def sha256(body):
    return hashlib.sha256(body).hexdigest()


def fingerprint(body, dtype):
    """The part of an array's bytes that is compared: some real numbers and their spread, else a digest."""
    if not dtype.startswith("<f"):
        return sha256(body)
    numbers = np.frombuffer(body, dtype).astype(np.float64)
    spread = [f(numbers).item() for f in (np.mean, np.std, np.min, np.max)] if numbers.size else []
    return [*spread, *numbers[:: max(1, len(numbers) // 16)].tolist()]


class Server(LocalServer):
    def call(self, method, path, **request):
        answer = httpx2.request(method, f"{self.url}{path}", timeout=60, **request)
        assert answer.status_code < 300, answer.text
        return answer


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """The folder of landmarks, summer and winter of one route as ready encodings."""
    folder = tmp_path_factory.mktemp("drives")
    rng = np.random.default_rng(11)
    places = np.cumsum(rng.normal(size=(150, 24)), axis=0)
    for season in ("autumn", "summer", "winter"):
        drive = places + rng.normal(size=24) + 0.7 * rng.normal(size=places.shape)
        np.save(folder / f"{season}.npy", drive.astype(np.float32))
    return folder


def content(path):
    """Every table of a map file, without what a clock or a release wrote."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as file:
        tables = [row[0] for row in file.execute("select name from sqlite_master where type = 'table' order by name")]
        cells = {}
        for table in (table for table in tables if not table.startswith(("_", "sqlite_"))):
            rows = file.execute(f"select * from {table} order by 1").fetchall()
            cells[table] = [
                [fingerprint(cell, dtype) if isinstance(cell, bytes) else cell for cell in row]
                for row in rows
                for dtype in [next((cell for cell in row if isinstance(cell, str) and cell[:1] == "<"), "")]
            ]
        return cells


@pytest.mark.parametrize("relevance", ["composed", "standardised", "rrf", "simbad", "brute_force"])
def test_map_file(drives, tmp_path, relevance):
    deepsimbad(
        *("map", "route", "--landmarks", drives / "autumn.npy", "--training", drives / "summer.npy", "--same-route"),
        *("--evaluator", "feature_l2:none", "--n-landmarks", "60", "--relevance", relevance, "--seed", "3"),
        *("--training-episodes", "200", "--data-dir", tmp_path / "data"),
    )
    cells = content(next(tmp_path.glob("data/domains/route/maps/*.sqlite")))
    for row in (row for rows in cells.values() for row in rows):
        for place, cell in enumerate(row):
            if isinstance(cell, str) and re.match(r"\d{4}-\d\d-\d\dT", cell):
                row[place] = "a time"
            elif isinstance(cell, str) and cell.startswith("{"):
                row[place] = without_clocks(json.loads(cell))
    cells["map"] = [row[:10] for row in cells["map"]]
    check(f"map-{relevance}", cells)


def without_clocks(document):
    """A JSON document without seconds, releases and digests of what holds times or sums."""
    if isinstance(document, dict):
        omitted = {"seconds", "release", "timings_ms", "created_at", "expires_at", "session_id", "job_id", "encode_ms"}
        omitted |= {"landmark_model_digest"}
        return {name: without_clocks(value) for name, value in document.items() if name not in omitted}
    if isinstance(document, list):
        return [without_clocks(value) for value in document]
    return document


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["vpr", "nbv"])
def test_experiments_on_real_data(real_data, tmp_path, kind):
    folder = real_data / "nordland_netvlad64"
    train, test, landmark = (f"{path}#0:500" for path in sorted(folder.glob("*.npy"))[:3])
    out = tmp_path / "out.json"
    options = [] if kind == "vpr" else ["--episodes", "30", "--training-episodes", "500"]
    deepsimbad(
        *("experiment", kind, "--landmarks", landmark, "--training", train, "--test", test, *options),
        *("--evaluator", "feature_l2:none", "--n-landmarks", "200", "--json", out),
    )
    document = without_clocks(json.loads(out.read_text()))
    document["config"] = {
        name: Path(value).name if isinstance(value, str) else value for name, value in document["config"].items()
    }
    check(f"experiment-{kind}", document)


def npz(**arrays):
    body = io.BytesIO()
    np.savez(body, **arrays)
    return body.getvalue()


@pytest.mark.slow
def test_answers_and_a_replayed_journal(drives, tmp_path):
    binary = {"Content-Type": "application/octet-stream"}
    autumn, summer, winter = (np.load(drives / f"{name}.npy") for name in ("autumn", "summer", "winter"))
    with Server(tmp_path / "data") as server:
        domain = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
        server.call("PUT", "/v1/admin/domains/route", json=domain)
        for name, drive in (("autumn", autumn), ("summer", summer)):
            server.call("POST", "/v1/admin/domains/route/traverses", json={"name": name})
            n = np.arange(len(drive))
            body = npz(encodings=drive, index=n, position_m=1.0 * n, x_m=1.0 * n, y_m=0.1 * n)
            path = f"/v1/admin/domains/route/traverses/{name}/frames"
            server.call("POST", path, content=body, headers=binary)
        config = {"training_traverse": "summer", "landmark_traverse": "autumn", "n_landmarks": 60, "seed": 3}
        job = server.call("POST", "/v1/admin/domains/route/remaps", json=config | {"training_episodes": 200}).json()
        while job["state"] in {"queued", "running"}:
            time.sleep(0.1)
            job = server.call("GET", f"/v1/admin/jobs/{job['job_id']}").json()
        assert job["state"] == "succeeded", job
        answers = {"domain": without_clocks(server.call("GET", "/v1/domains/route").json())}
        view = {"encoding": winter[70].tolist()}
        answers["localization"] = server.call("POST", "/v1/domains/route/localizations", json=view).json()
        answers["metrics"] = job["result"]["metrics"]
        begins = {
            "grid": {},
            "particle": {"belief": "particle", "seed": 7, "start_position_m": 20.0},
            "paper": {"belief": "particle", "update": "additive_relevance", "planner": "nnql"},
        }
        paths = {}
        for name, begin in begins.items():
            answer = server.call("POST", "/v1/domains/route/sessions", json=begin).json()
            paths[name] = f"/v1/sessions/{answer['session_id']}"
            for step in range(14):
                view = {"encoding": winter[20 + 3 * step].tolist()}
                answer = server.call("POST", f"{paths[name]}/observations?action_m=3", json=view).json()
            answers[name] = answer
        beliefs = {
            name: server.call("GET", f"{path}/belief", headers={"Accept": "application/octet-stream"}).content
            for name, path in paths.items()
        }
        answers |= {f"belief of {name}": np.load(io.BytesIO(body)).tolist() for name, body in beliefs.items()}
        server.kill()
    with Server(tmp_path / "data") as server:
        for name, path in paths.items():
            belief = server.call("GET", f"{path}/belief", headers={"Accept": "application/octet-stream"}).content
            assert belief == beliefs[name], f"{name} went on otherwise after a restart"
        check("openapi", server.call("GET", "/openapi.json").json())
    # A draw on the border of two particles falls to the other one on another processor, and later draws differ by it.
    particles = {name: answers.pop(name) for name in ("particle", "belief of particle", "paper", "belief of paper")}
    for name in ("particle", "paper"):
        particles[name]["belief"]["top"] = particles[name]["belief"]["top"][:1]
    check("answers", without_clocks(answers))
    check("particles", without_clocks(particles), abs=0.03)


def test_help():
    texts = {}
    programs = (
        ("python -m deepsimbad", commands, 78, COMMANDS),
        ("deepsimbad-client", cli, 98, CLIENT_COMMANDS),
    )
    for program, group, width, names in programs:
        for name in ("", *names):
            result = CliRunner().invoke(group, [*name.split(), "--help"], prog_name=program, terminal_width=width)
            assert result.exit_code == 0, result.output
            texts[f"{program.removeprefix('python -m ')} {name}".strip()] = result.output
    check("help", texts)


def test_both_commands_have_one_order_of_words():
    """Words are a verb, or a noun that is listed, or a group and its verb; then the domain; then the rest."""
    service_commands, client_commands = (
        {name: group.get_command(Context(group), name) for name in group.list_commands(Context(group))}
        for group in (commands, cli)
    )
    assert {name for name, command in service_commands.items() if isinstance(command, Group)} == {
        *("experiment", "keys", "ray", "weights")
    }
    assert not any(isinstance(command, Group) for command in client_commands.values())
    for command in (*service_commands.values(), *client_commands.values()):
        words = [parameter.human_readable_name for parameter in command.params if isinstance(parameter, Argument)]
        assert not any("DOMAIN" in word.upper() for word in words[1:]), f"{command.name} {words}"
    common_names = set(service_commands) & set(client_commands)
    assert common_names == {"delete-domain", "localize"}
    for name in common_names:
        usages = {
            " ".join(group[name].collect_usage_pieces(Context(group[name])))
            for group in (service_commands, client_commands)
        }
        assert len(usages) == 1, usages
    versions = [CliRunner().invoke(group, ["--version"]).output for group in (commands, cli)]
    assert versions == [f"{version('deep-simbad')}\n"] * 2
