"""The OpenAPI document says what the service does."""

import json
import re
from typing import Any

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.localizations import ObservationBody
from deepsimbad.api.openapi import BODY_EXAMPLES, ENCODED_ON_BOARD, _declared_bodies

OPERATIONS = """
GET /healthz
GET /readyz
GET /metrics
GET /v1/domains
GET /v1/domains/{domain}
GET /v1/domains/{domain}/landmark-model
POST /v1/domains/{domain}/localizations
POST /v1/domains/{domain}/sessions
POST /v1/sessions/{session_id}/observations
GET /v1/sessions/{session_id}
GET /v1/sessions/{session_id}/belief
GET /v1/sessions/{session_id}/next-best-view
PUT /v1/sessions/{session_id}/prior
POST /v1/sessions/{session_id}/truths
DELETE /v1/sessions/{session_id}
PUT /v1/admin/domains/{domain}
DELETE /v1/admin/domains/{domain}
POST /v1/admin/domains/{domain}/traverses
GET /v1/admin/domains/{domain}/traverses
GET /v1/admin/domains/{domain}/traverses/{name}
DELETE /v1/admin/domains/{domain}/traverses/{name}
PUT /v1/admin/domains/{domain}/traverses/{name}/frames/{index}
POST /v1/admin/domains/{domain}/traverses/{name}/frames
POST /v1/admin/domains/{domain}/remaps
POST /v1/admin/domains/{domain}/experience
GET /v1/admin/domains/{domain}/maps
GET /v1/admin/domains/{domain}/maps/{version}/file
DELETE /v1/admin/domains/{domain}/maps/{version}
PUT /v1/admin/domains/{domain}/active-map
GET /v1/admin/sessions
GET /v1/admin/jobs
GET /v1/admin/jobs/{job_id}
GET /v1/admin/jobs/{job_id}/events
DELETE /v1/admin/jobs/{job_id}
"""
PROBLEM = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}


@pytest.fixture(scope="module")
def document(client: TestClient) -> dict[str, Any]:
    found: dict[str, Any] = client.get("/openapi.json").json()
    return found


@pytest.fixture(scope="module")
def operations(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {
        f"{method.upper()} {path}": operation
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    }


def test_it_lists_the_contracts_calls_and_no_other(operations: dict[str, Any]) -> None:
    assert sorted(operations) == sorted(OPERATIONS.split("\n")[1:-1])


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    names = set(re.findall(r"#/components/schemas/(\w+)", str(document)))
    assert names <= set(document["components"]["schemas"])
    assert "HTTPValidationError" not in document["components"]["schemas"]


def test_every_error_is_a_problem(operations: dict[str, Any]) -> None:
    for name, operation in operations.items():
        errors = {status for status in operation["responses"] if int(status) >= 400}
        assert {"500", "503"} <= errors, name
        for status in errors:
            assert operation["responses"][status]["content"] == PROBLEM, (name, status)


def test_whatever_takes_parameters_or_a_body_may_refuse_them(operations: dict[str, Any]) -> None:
    for name, operation in operations.items():
        statuses = set(operation["responses"])
        if operation.get("parameters"):
            assert "422" in statuses, name
        if "requestBody" in operation:
            assert {"413", "415", "422"} <= statuses, name
            assert operation["requestBody"]["required"] is True, name
        assert ("requestBody" in operation) == name.startswith(("POST", "PUT")), name


def test_bodies_and_answers_by_media_type(operations: dict[str, Any]) -> None:
    images = {"image/jpeg", "image/png", "image/tiff", "image/webp"}
    localize = operations["POST /v1/domains/{domain}/localizations"]
    seen = images | {"application/json", "application/vnd.deepsimbad.ranks"}
    for name in ("domains/{domain}/localizations", "sessions/{session_id}/observations"):
        assert set(operations[f"POST /v1/{name}"]["requestBody"]["content"]) == seen
    assert set(operations["GET /v1/domains/{domain}/landmark-model"]["responses"]["200"]["content"]) == {
        "application/octet-stream"
    }
    assert set(localize["responses"]["200"]["content"]) == {"application/json", "application/octet-stream"}
    base = "/v1/admin/domains/{domain}/traverses/{name}/frames"
    assert set(operations[f"PUT {base}/{{index}}"]["requestBody"]["content"]) == images | {"application/json"}
    assert set(operations[f"POST {base}"]["requestBody"]["content"]) == {"application/octet-stream"}
    assert set(operations["GET /v1/admin/jobs/{job_id}/events"]["responses"]["200"]["content"]) == {"text/event-stream"}
    assert set(operations["GET /metrics"]["responses"]["200"]["content"]) == {"text/plain"}
    for name, operation in operations.items():
        if name.startswith("DELETE"):
            assert "content" not in operation["responses"]["204"], name


def test_names_carry_their_pattern(operations: dict[str, Any]) -> None:
    for name, operation in operations.items():
        for parameter in operation.get("parameters", []):
            if parameter["in"] == "path" and parameter["name"] not in {"index", "version"}:
                assert parameter["schema"]["pattern"] == "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$", name


def test_every_body_has_an_example_that_is_taken(document: dict[str, Any]) -> None:
    assert set(_declared_bodies) == set(BODY_EXAMPLES)
    for model in _declared_bodies.values():
        (example,) = document["components"]["schemas"][model.__name__]["examples"]
        model.model_validate_json(json.dumps(example))
    ObservationBody.model_validate_json(json.dumps(ENCODED_ON_BOARD))


def test_every_parameter_in_a_path_has_an_example(operations: dict[str, Any]) -> None:
    for name, operation in operations.items():
        for parameter in operation.get("parameters", []):
            assert "example" in parameter or parameter["in"] != "path", (name, parameter["name"])


def test_links_lead_to_operations_and_give_what_their_paths_need(operations: dict[str, Any]) -> None:
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


def test_pairs_are_written_for_every_reader(document: dict[str, Any]) -> None:
    assert "prefixItems" not in json.dumps(document)
    size = document["components"]["schemas"]["DomainAnswer"]["properties"]["input_size"]["anyOf"][0]
    assert size == {"type": "array", "items": {"type": "integer"}, "minItems": 2, "maxItems": 2}


def test_every_member_of_an_answer_is_required(document: dict[str, Any]) -> None:
    answers = [name for name in document["components"]["schemas"] if name.endswith(("Answer", "List"))]
    assert len(answers) > 10
    for name in answers:
        schema = document["components"]["schemas"][name]
        assert set(schema["required"]) == set(schema["properties"]), name
