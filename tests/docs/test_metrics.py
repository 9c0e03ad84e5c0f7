"""Metrics, log lines, alarms and the page that explains them are of one mind."""

import ast
import re

import pytest
import yaml
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.settings import Settings

from .conftest import PROJECT, Page

PAGE = Page(PROJECT / "docs" / "operations.md")
OF_HISTOGRAMS = re.compile(r"_(?:bucket|sum|count)$")
LEVELS = {"info": "INFO", "warning": "WARNING", "error": "ERROR", "exception": "ERROR"}
ALARMS = [
    rule
    for group in yaml.safe_load((PROJECT / "deploy" / "alerts.yml").read_text())["groups"]
    for rule in group["rules"]
]


@pytest.fixture(scope="module")
def metrics(tmp_path_factory):
    """What a service tells that has answered something."""
    with TestClient(create_app(Settings(data_dir=tmp_path_factory.mktemp("used")))) as client:
        body = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
        assert client.put("/v1/admin/domains/d", json=body).status_code == 201
        client.post("/v1/sessions/nobody/observations", json={"ranked_landmarks": [1]})
        metrics = client.app.state.services.metrics
        metrics.record_localization("d", {"plan": 1.0}, 3.0)
        metrics.record_truths("d", [0.5])
        metrics.count_refusal("rate_limited")
        metrics.record_job("remap", "failed", 1.0)
        return client.get("/metrics").text


@pytest.fixture(scope="module")
def kinds(metrics):
    """Type of every metric by its name."""
    return dict(re.findall(r"^# TYPE (\S+) (\S+)$", metrics, re.MULTILINE))


@pytest.fixture(scope="module")
def explained():
    """The page's table of metrics: type and labels by name."""
    rows = re.findall(r"^\| `((?:deepsimbad|process)_\w+)` \| (\w+) \|([^|]*)\|", PAGE.text, re.MULTILINE)
    assert len({name for name, *_ in rows}) == len(rows), "a metric is explained twice"
    return {name: (kind, set(labels.strip().split(", ")) - {""}) for name, kind, labels in rows}


def test_every_metric_is_explained_with_its_labels_and_no_other(metrics, kinds, explained):
    assert len(kinds) > 25
    assert {name: kind for name, (kind, _) in explained.items()} == kinds
    labels_of = {}
    for name, labels in re.findall(r"^((?:deepsimbad|process)_\w+?)(?:\{(.*)\})? \S+$", metrics, re.MULTILINE):
        names = set(re.findall(r'(\w+)="', labels)) - {"le"}
        labels_of.setdefault(OF_HISTOGRAMS.sub("", name), set()).update(names)
    assert len(labels_of) > 20
    assert labels_of == {name: explained[name][1] for name in labels_of}


def test_alarms_look_at_metrics_and_labels_that_exist(kinds, explained):
    by_prometheus = {"job", "instance", "le"}
    for alarm in ALARMS:
        for name in re.findall(r"\b(?:deepsimbad|process)_\w+", alarm["expr"]):
            is_histogram = kinds.get(OF_HISTOGRAMS.sub("", name)) == "histogram"
            assert name in kinds or is_histogram, f"{alarm['alert']} looks at {name}"
        selectors = re.findall(r"((?:deepsimbad|process)_\w+)\{([^}]*(?:\{\w+\}[^}]*)*)\}", alarm["expr"])
        for name, selector in selectors:
            labels = explained[OF_HISTOGRAMS.sub("", name)][1] | by_prometheus
            assert set(re.findall(r'(\w+)[=!]~?"', selector)) <= labels, alarm["alert"]


def test_every_alarm_is_tried_and_has_a_section_that_says_how_urgent_it_is():
    sections = dict(re.findall(r"^### (DeepSimbad\w+)\n\n\*(page|ticket)\.\*", PAGE.text, re.MULTILINE))
    assert sections == {alarm["alert"]: alarm["labels"]["severity"] for alarm in ALARMS}
    trials = yaml.safe_load((PROJECT / "deploy" / "alerts_test.yml").read_text())["tests"]
    ringing = {rule["alertname"] for trial in trials for rule in trial["alert_rule_test"] if "exp_alerts" in rule}
    assert ringing == set(sections)


def messages_of(source):
    """Level of every message that is logged, as far as its words are constant: up to a colon."""
    levels = {}
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Name(id="log" | "_log"), attr=method), args=[message, *_]) if (
                method in LEVELS
            ):
                constants = [part.value for part in ast.walk(message) if isinstance(part, ast.Constant)]
                words = [value.split(":")[0] for value in constants if isinstance(value, str)]
                assert words, ast.unparse(node)
                levels |= dict.fromkeys(words, LEVELS[method])
    return levels


def test_every_log_line_is_explained_with_its_level_and_no_other():
    table = PAGE.text.split("### Log lines")[1].split("### Metrics")[0]
    explained_levels, logged_levels = {}, {}
    for first, second in re.findall(r"^\| (`[^|]*) \| ([A-Z, ]+) \|", table, re.MULTILINE):
        messages, levels = re.findall(r"`([^`]+)`", first), second.split(", ")  # one level for all, or one for each
        explained_levels |= dict(zip(messages, levels if len(levels) > 1 else levels * len(messages), strict=True))
    for path in (PROJECT / "service" / "deepsimbad").rglob("*.py"):
        logged_levels |= messages_of(path.read_text(encoding="utf-8"))
    assert len(logged_levels) > 30
    assert explained_levels == logged_levels
    source = 'log.info("a" if b else "c", extra={"d": 1})\n_log.exception("e: %s", f)\nlog.isEnabledFor("g")'
    assert messages_of(source) == {"a": "INFO", "c": "INFO", "e": "ERROR"}
