"""The table from errors to statuses, and what a problem document can carry."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from deepsimbad import errors
from deepsimbad.api.problems import error_response, install_problem_handlers, status_of
from deepsimbad.errors import DeepSimbadError

SCOPE: dict[str, Any] = {"type": "http", "raw_path": b"/v1/x%ff?q=1", "state": {"request_id": "r1"}}


def all_errors(root: type[DeepSimbadError] = DeepSimbadError) -> Iterator[type[DeepSimbadError]]:
    for branch in root.__subclasses__():
        yield branch
        yield from all_errors(branch)


EXPECTED = {
    errors.InvalidInputError: 422,
    errors.EmptyBodyError: 422,
    errors.TruncatedImageError: 422,
    errors.InvalidMapConfigError: 422,
    errors.SettingsError: 500,
    errors.NotFoundError: 404,
    errors.UnknownJobError: 404,
    errors.ConflictError: 409,
    errors.NoActiveMapError: 409,
    errors.LostActivationError: 409,
    errors.BodyTooLargeError: 413,
    errors.ImageTooLargeError: 413,
    errors.UnsupportedMediaTypeError: 415,
    errors.UnavailableError: 503,
    errors.DamagedMapError: 503,
    errors.CancelledError: 409,
    errors.GoneError: 410,
    errors.EndedSessionError: 410,
    errors.RetiredMapError: 410,
    errors.BusyError: 429,
    errors.TooManySessionsError: 429,
    errors.PastTheEndError: 422,
    errors.UnknownSessionError: 404,
    errors.DeepSimbadError: 500,
}


@pytest.mark.parametrize(("kind", "status"), EXPECTED.items())
def test_statuses(kind: type[DeepSimbadError], status: int) -> None:
    assert status_of(kind("x")) == status


def test_every_error_of_the_tree_has_a_status_and_a_document() -> None:
    codes = set()
    for kind in all_errors():
        if kind is errors.SettingsError:
            continue
        answer = error_response(SCOPE, kind("what is wrong"))
        problem = json.loads(bytes(answer.body))
        assert 400 <= answer.status_code < 600
        assert answer.status_code != 500, kind
        assert problem["title"], kind
        assert not problem["title"].endswith("."), kind
        assert problem["code"] == kind.code
        codes.add(kind.code)
    assert len(codes) > 20


def test_hints_that_json_cannot_hold_still_travel() -> None:
    hints = {
        "number": float("nan"),
        "array": np.float32(2.5),
        "many": (1, float("inf")),
        "text": "lone \ud800 surrogate",
        "nested": {"id": np.int64(3), "other": object},
        "status": "a hint cannot displace a member",
    }
    problem = json.loads(bytes(error_response(SCOPE, errors.InvalidInputError("x", **hints)).body))
    assert problem["number"] == "nan"
    assert problem["array"] == 2.5
    assert problem["many"] == [1, "inf"]
    assert problem["nested"]["id"] == 3
    assert problem["status"] == 422
    assert problem["instance"] == "/v1/x%ff"
    assert problem["request_id"] == "r1"


def test_unavailable_says_when_to_try_again() -> None:
    assert int(error_response(SCOPE, errors.UnavailableError("x")).headers["retry-after"]) > 0
    assert int(error_response(SCOPE, errors.BusyError("x")).headers["retry-after"]) > 0
    assert error_response(SCOPE, errors.BusyError("x", retry_after_s=17)).headers["retry-after"] == "17"
    assert "retry-after" not in error_response(SCOPE, errors.ConflictError("x")).headers


def test_a_503_is_logged_with_its_request_and_with_a_stack_where_something_stands_behind_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with pytest.raises(errors.UnavailableError) as caught:
        raise errors.UnavailableError("x is full") from OSError("no space")
    for error in (errors.UnavailableError("12 MiB are free"), caught.value):
        error_response(SCOPE, error)
    told, behind = (vars(record) for record in caplog.records)
    assert (told["request_id"], told["exc_info"]) == ("r1", None)
    assert (told["msg"], told["code"], told["why"]) == ("not answered", "unavailable", "12 MiB are free")
    assert (behind["request_id"], behind["exc_info"][1]) == ("r1", caught.value)


def test_a_framework_error_is_a_problem_too() -> None:
    app = FastAPI()
    install_problem_handlers(app)

    @app.get("/number/{n}")
    async def number(n: int, x: float = 0) -> dict[str, float]:
        return {"n": n + x}

    client = TestClient(app)
    answer = client.get("/number/three?x=y")
    assert answer.status_code == 422
    assert [error["loc"] for error in answer.json()["errors"]] == [["path", "n"], ["query", "x"]]
    assert "three" not in answer.text.replace("/number/three", "")  # input is not echoed
