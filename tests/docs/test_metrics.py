"""Metrics, alarms and the page that explains them are of one mind."""

import re
from pathlib import Path

import pytest
import yaml
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.settings import Settings

from .conftest import Page

PROJECT = Path(__file__).resolve().parents[2]
_OF_HISTOGRAMS = re.compile(r"_(?:bucket|sum|count)$")
_METRIC = re.compile(r"\b(?:deepsimbad|process)_\w+")


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(PROJECT / "docs" / "operations.md")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Type of every metric by its name, as a service without any domain tells them."""
    with TestClient(create_app(Settings(data_dir=tmp_path_factory.mktemp("served")))) as client:
        text = client.get("/metrics").text
    return dict(re.findall(r"^# TYPE (\S+) (\S+)$", text, re.MULTILINE))


def rows(page: Page) -> dict[str, list[str]]:
    """The table of metrics: cells by name."""
    found = re.findall(r"^\| `((?:deepsimbad|process)_\w+)` \| ([^\n]*) \|$", page.text, re.MULTILINE)
    assert len({name for name, _ in found}) == len(found), "a metric is explained twice"
    return {name: [cell.strip() for cell in cells.split("|")] for name, cells in found}


def test_every_metric_is_explained_and_no_other(page: Page, served: dict[str, str]) -> None:
    explained = {name: cells[0] for name, cells in rows(page).items()}
    assert len(served) > 25
    assert explained == served


def test_labels_are_those_that_are_explained(page: Page, client_metrics: str) -> None:
    shown: dict[str, set[str]] = {}
    for name, labels in re.findall(r"^((?:deepsimbad|process)_\w+?)(?:\{(.*)\})? \S+$", client_metrics, re.MULTILINE):
        known = set(re.findall(r'(\w+)="', labels)) - {"le"}
        shown.setdefault(_OF_HISTOGRAMS.sub("", name), set()).update(known)
    explained = {name: set(cells[1].split(", ")) - {""} for name, cells in rows(page).items()}
    assert len(shown) > 20
    for name, labels in shown.items():
        assert labels == explained[name], name


@pytest.fixture(scope="module")
def client_metrics(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a service tells that has answered something."""
    with TestClient(create_app(Settings(data_dir=tmp_path_factory.mktemp("used")))) as client:
        body = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
        assert client.put("/v1/admin/domains/d", json=body).status_code == 201
        client.post("/v1/sessions/nobody/observations", json={"ranked_landmarks": [1]})
        metrics = client.app.state.services.metrics  # type: ignore[attr-defined]
        metrics.localized("d", {"plan": 1.0}, 3.0)
        metrics.fed_back("d", [0.5])
        metrics.refused("rate_limited")
        metrics.job_ended("remap", "failed", 1.0)
        return client.get("/metrics").text


@pytest.fixture(scope="module")
def alarms() -> list[dict[str, object]]:
    found = yaml.safe_load((PROJECT / "deploy" / "alerts.yml").read_text())
    return [rule for group in found["groups"] for rule in group["rules"]]


def test_alarms_look_at_metrics_that_exist(alarms: list[dict[str, object]], served: dict[str, str]) -> None:
    for alarm in alarms:
        for name in _METRIC.findall(str(alarm["expr"])):
            base = _OF_HISTOGRAMS.sub("", name)
            assert name in served or served.get(base) == "histogram", f"{alarm['alert']} looks at {name}"


def test_alarms_look_at_labels_that_exist(alarms: list[dict[str, object]], page: Page) -> None:
    given = {"job", "instance", "le"}  # by Prometheus itself
    explained = rows(page)
    for alarm in alarms:
        for name, selector in re.findall(
            r"((?:deepsimbad|process)_\w+)\{([^}]*(?:\{\w+\}[^}]*)*)\}", str(alarm["expr"])
        ):
            known = set(explained[_OF_HISTOGRAMS.sub("", name)][1].split(", ")) | given
            assert set(re.findall(r'(\w+)[=!]~?"', selector)) <= known, alarm["alert"]


def test_every_alarm_has_a_section_that_says_how_urgent_it_is(alarms: list[dict[str, object]], page: Page) -> None:
    sections = dict(re.findall(r"^### (DeepSimbad\w+)\n\n\*(page|ticket)\.\*", page.text, re.MULTILINE))
    assert sections == {alarm["alert"]: alarm["labels"]["severity"] for alarm in alarms}  # type: ignore[index]


def test_every_alarm_is_tried(alarms: list[dict[str, object]]) -> None:
    tried = yaml.safe_load((PROJECT / "deploy" / "alerts_test.yml").read_text())["tests"]
    ringing = {each["alertname"] for test in tried for each in test["alert_rule_test"] if "exp_alerts" in each}
    assert ringing == {alarm["alert"] for alarm in alarms}
