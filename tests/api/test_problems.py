"""The table from errors to statuses, and what a problem document can carry."""

import json

import numpy as np
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from deepsimbad import errors
from deepsimbad.api.problems import error_response, install_problem_handlers, status_of
from deepsimbad.errors import DeepSimbadError

SCOPE = {"type": "http", "raw_path": b"/v1/x%ff?q=1", "state": {"request_id": "r1"}}
EXPECTED = {
    404: (errors.NotFoundError, errors.UnknownJobError, errors.UnknownSessionError),
    409: (errors.ConflictError, errors.NoActiveMapError, errors.LostActivationError, errors.CancelledError),
    410: (errors.GoneError, errors.EndedSessionError, errors.RetiredMapError),
    413: (errors.BodyTooLargeError, errors.ImageTooLargeError),
    415: (errors.UnsupportedMediaTypeError,),
    422: (errors.InvalidInputError, errors.EmptyBodyError, errors.InvalidMapConfigError, errors.PastTheEndError),
    429: (errors.BusyError, errors.TooManySessionsError),
    500: (errors.DeepSimbadError, errors.SettingsError),
    503: (errors.UnavailableError, errors.DamagedMapError),
}


def all_errors(root=DeepSimbadError):
    for branch in root.__subclasses__():
        yield branch
        yield from all_errors(branch)


def document(error):
    return json.loads(bytes(error_response(SCOPE, error).body))


def test_every_error_of_the_tree_has_a_status_and_a_document():
    for status, kinds in EXPECTED.items():
        assert {status_of(kind("x")) for kind in kinds} == {status}
    kinds = set(all_errors()) - {errors.SettingsError}
    for kind in kinds:
        answer = error_response(SCOPE, kind("what is wrong"))
        problem = json.loads(bytes(answer.body))
        assert 400 <= answer.status_code < 600
        assert answer.status_code != 500, kind
        assert problem["title"].strip(".") == problem["title"] != "", kind
        assert problem["code"] == kind.code
    assert len({kind.code for kind in kinds}) > 20


def test_hints_that_json_cannot_hold_still_travel():
    problem = document(
        errors.InvalidInputError(
            "x",
            number=np.float32(2.5),
            many=(1, 2),
            text="lone \ud800 surrogate",
            nested={"id": np.int64(3)},
            status="a hint cannot displace a member",
        )
    )
    expected = {"number": 2.5, "many": [1, 2], "nested": {"id": 3}, "status": 422, "instance": "/v1/x%ff"}
    assert problem.items() >= {**expected, "request_id": "r1"}.items()


def test_what_may_be_tried_again_says_when():
    for error, retry_after in (
        (errors.UnavailableError("x"), "5"),
        (errors.BusyError("x"), "5"),
        (errors.BusyError("x", retry_after_s=17), "17"),
        (errors.ConflictError("x"), None),
    ):
        assert error_response(SCOPE, error).headers.get("retry-after") == retry_after


def test_a_503_is_logged_with_its_request_and_with_a_stack_where_something_stands_behind_it(caplog):
    with pytest.raises(errors.UnavailableError) as caught:
        raise errors.UnavailableError("x is full") from OSError("no space")
    for error in (errors.UnavailableError("12 MiB are free"), caught.value):
        document(error)
    bare, behind = (vars(record) for record in caplog.records)
    assert (bare["request_id"], bare["exc_info"]) == ("r1", None)
    assert (bare["msg"], bare["code"], bare["why"]) == ("not answered", "unavailable", "12 MiB are free")
    assert (behind["request_id"], behind["exc_info"][1]) == ("r1", caught.value)


def test_a_framework_error_is_a_problem_too():
    app = FastAPI()
    install_problem_handlers(app)

    @app.get("/number/{n}")
    async def number(n: int, x: float = 0) -> dict[str, float]:
        return {"n": n + x}

    answer = TestClient(app).get("/number/three?x=y")
    assert answer.status_code == 422
    assert [error["loc"] for error in answer.json()["errors"]] == [["path", "n"], ["query", "x"]]
    assert "three" not in answer.text.replace("/number/three", "")  # input is not echoed
