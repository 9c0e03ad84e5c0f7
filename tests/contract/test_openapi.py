"""Laws of the OpenAPI document; tests/golden pins its text."""

import json
import os
import re
from pathlib import Path

import pytest

from deepsimbad.api import problems
from deepsimbad.api.localizations import ObservationBody
from deepsimbad.api.problems import BODY_EXAMPLES, ENCODED_ON_BOARD, _declared_bodies

from .conftest import ready_encodings

PROBLEM = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
NAME = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"


@pytest.fixture(scope="module")
def document(client):
    return client.get("/openapi.json").json()


@pytest.fixture(scope="module")
def operations(document):
    return {
        f"{method.upper()} {path}": operation
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    }


def test_what_an_operation_may_answer(operations):
    for name, operation in operations.items():
        answers = operation["responses"]
        errors = {status for status in answers if int(status) >= 400}
        assert {"500", "503"} <= errors, name
        assert [answers[status]["content"] for status in errors] == [PROBLEM] * len(errors), name
        assert "422" in errors or not operation.get("parameters"), name
        has_body = name.startswith(("POST", "PUT")) and not name.endswith("/warm")
        assert ("requestBody" in operation) == has_body, name
        if "requestBody" in operation:
            assert {"413", "415", "422"} <= errors, name
            assert operation["requestBody"]["required"] is True, name
        if name.startswith("DELETE"):
            assert "content" not in answers["204"], name


def test_parameters_in_paths_carry_pattern_and_example(operations):
    for name, operation in operations.items():
        for parameter in operation.get("parameters", []):
            if parameter["in"] == "path":
                assert "example" in parameter, name
                assert parameter["name"] in {"index", "version"} or parameter["schema"]["pattern"] == NAME, name


def test_every_body_has_an_example_that_is_taken(document):
    assert set(_declared_bodies) == set(BODY_EXAMPLES)
    for model in _declared_bodies.values():
        (example,) = document["components"]["schemas"][model.__name__]["examples"]
        model.model_validate_json(json.dumps(example))
    ObservationBody.model_validate_json(json.dumps(ENCODED_ON_BOARD))


def test_links_lead_to_operations_and_give_what_their_paths_need(operations):
    by_id = {operation["operationId"]: name for name, operation in operations.items()}
    assert len(by_id) == len(operations)
    reached = set()
    for operation in operations.values():
        for answer in operation["responses"].values():
            for link in answer.get("links", {}).values():
                target = by_id[link["operationId"]]
                reached.add(target)
                assert set(re.findall(r"{(\w+)}", target)) == set(link["parameters"])
    assert {name for name in operations if "{session_id}" in name or "{job_id}" in name} <= reached


def test_schemas_are_there_for_every_reader(document):
    schemas, text = document["components"]["schemas"], json.dumps(document)
    assert set(re.findall(r"#/components/schemas/(\w+)", text)) <= set(schemas)
    assert "HTTPValidationError" not in schemas
    assert "prefixItems" not in text
    answers = {name: schema for name, schema in schemas.items() if name.endswith(("Answer", "List"))}
    assert len(answers) > 10
    for name, schema in answers.items():
        assert set(schema["required"]) == set(schema["properties"]), name


def test_every_summary_is_a_sentence(operations):
    summaries = [operation["summary"] for operation in operations.values()]
    assert all(re.fullmatch(r"[A-Z][^.]* [^.]*\.", summary) for summary in summaries), summaries


def test_examples_are_real_answers(client, domain, document):
    """GOLDEN_UPDATE=1 writes them anew."""
    place, view = f"/v1/domains/{domain}", {"encoding": ready_encodings()[6].tolist()}
    job = client.remap(domain, landmark_traverse="drive", training_episodes=20)
    session = client.post(f"{place}/sessions", json={}).json()
    observations = f"/v1/sessions/{session['session_id']}/observations?shortlist=3"
    client.post(observations, json=view)
    answers = {
        "DomainAnswer": client.get(place).json(),
        "JobAnswer": job,
        "LocalizationAnswer": client.post(f"{place}/localizations?shortlist=3", json=view).json(),
        "ObservationAnswer": client.post(f"{observations}&action_m=2", json=view).json(),
        "SessionAnswer": session,
        "TraverseAnswer": client.get(f"/v1/admin/domains/{domain}/traverses/drive").json(),
    }
    if os.environ.get("GOLDEN_UPDATE"):
        text = json.dumps(shortened(answers), indent=None, sort_keys=True).replace('}, "', '},\n"')
        Path(problems.__file__).with_name("examples.json").write_text(text + "\n")
    for name, answer in answers.items():
        (example,) = document["components"]["schemas"][name]["examples"]
        assert members(example) == members(answer), name


def shortened(value):
    if isinstance(value, dict):
        return {name: shortened(member) for name, member in value.items()}
    if isinstance(value, list):
        return [shortened(member) for member in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def members(value, place=""):
    """Every place where a member of an object stands."""
    if isinstance(value, list):
        return set().union(*(members(member, f"{place}[]") for member in value))
    if not isinstance(value, dict):
        return set()
    return {f"{place}.{name}" for name in value}.union(*(members(value[name], f"{place}.{name}") for name in value))
