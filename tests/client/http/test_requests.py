"""What goes over the wire, and what becomes of the answers."""

import ast
import asyncio
import json
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pydantic
import pytest

from deepsimbad_client import AsyncClient, Client, errors
from deepsimbad_client.errors import BY_CODE, BY_STATUS, InvalidArgumentError
from deepsimbad_client.http.models import Domain, Traverse
from deepsimbad_client.http.observation import media_type_of, observation
from deepsimbad_client.http.retry import RETRIED_STATUSES

BELIEF = {
    "mean_m": 1.0,
    "mode_m": 2.0,
    "std_m": 0.5,
    "credible_95_m": [9.0, 1.0],
    "entropy_bits": 2.0,
    "off_route": None,
    "histogram": {"edges_m": [0.0, 1.0], "mass": [1.0]},
    "top": [{"map_image": 3, "route_position_m": 2.0, "x_m": None, "y_m": None, "mass": 0.5}],
}
LOCALIZATION = {
    "map_version": 7,
    "timings_ms": {"total": 1.5},
    "belief": BELIEF,
    "retrieval": [{"map_image": 3, "route_position_m": 2.0, "relevance": 1.25}],
    "next_best_view": None,
}


class Recorder:
    """Answers everything alike and remembers the last request."""

    def __init__(self, response: httpx2.Response) -> None:
        self.response = response
        self.request = httpx2.Request("GET", "http://nothing")

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.request = request
        return self.response


def asked(document: Any, status: int = 200, **options: Any) -> tuple[Client, Recorder]:
    recorder = Recorder(httpx2.Response(status, json=document))
    return Client("http://service/", transport=httpx2.MockTransport(recorder), **options), recorder


def test_localize_reads_the_whole_answer_and_what_it_does_not_know_yet() -> None:
    service, recorder = asked(LOCALIZATION | {"of_the_future": [1]})
    found = service.localize("campus", b"\x89PNG\r\n\x1a\n...", shortlist=4)
    assert (found.map_version, found.belief.credible_95_m, found.retrieval[0].relevance) == (7, (9.0, 1.0), 1.25)
    assert found.belief.top[0].x_m is None
    assert (found.model_extra or {})["of_the_future"] == [1]
    assert recorder.request.url == "http://service/v1/domains/campus/localizations?shortlist=4"
    assert recorder.request.headers["content-type"] == "image/png"
    with pytest.raises(pydantic.ValidationError):
        found.map_version = 8  # type: ignore[misc]


@pytest.mark.parametrize(
    ("form", "body"),
    [
        ({"ranked_landmarks": (4, 2)}, {"ranked_landmarks": [4, 2]}),
        ({"ranked_landmarks": np.array([4, 2], np.uint16)}, {"ranked_landmarks": [4, 2]}),
        ({"dissimilarities": np.array([0.5], np.float32)}, {"dissimilarities": [0.5]}),
        ({"encoding": [1.0]}, {"encoding": [1.0]}),
    ],
)
def test_what_a_robot_encodes_itself_travels_as_json(form: dict[str, Any], body: dict[str, Any]) -> None:
    service, recorder = asked(LOCALIZATION)
    service.localize("campus", **form)
    assert json.loads(recorder.request.content) == body
    assert recorder.request.headers["content-type"] == "application/json"


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"image": b"\xff\xd8\xff", "encoding": [1.0]},
        {"image": b"GIF89a"},
        {"dissimilarities": [float("nan")]},
        {"encoding": np.array([np.inf])},
        {"ranked_landmarks": [object()]},
    ],
)
def test_what_can_never_be_sent_is_refused_here(form: dict[str, Any]) -> None:
    with pytest.raises(InvalidArgumentError):
        observation(**form)


def test_an_image_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(errors.BrokenFrameError, match=r"no\.jpg"):
        observation(tmp_path / "no.jpg")


@pytest.mark.parametrize(
    ("body", "media_type"),
    [
        (b"\xff\xd8\xff\xe0", "image/jpeg"),
        (b"\x89PNG\r\n\x1a\n", "image/png"),
        (b"II*\0", "image/tiff"),
        (b"MM\0*", "image/tiff"),
        (b"RIFF\n\0\0\nWEBPVP8 ", "image/webp"),
        (b"RIFF\0\0\0\0WAVE", None),
        (b"", None),
    ],
)
def test_media_type_of(body: bytes, media_type: str | None) -> None:
    assert media_type_of(body) == media_type


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a b", "-a", "é", "a" * 65, "a\n"])
def test_a_name_that_could_leave_its_place_in_the_address(name: str) -> None:
    service, _ = asked({})
    with pytest.raises(InvalidArgumentError, match="letters"):
        service.domain(name)


@pytest.mark.parametrize("url", ["service:8000", "ftp://service", "http://", "//service", "http://:::"])
def test_an_address_that_is_none(url: str) -> None:
    with pytest.raises(InvalidArgumentError, match="is no address"):
        Client(url)


def test_address_and_key_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEEPSIMBAD_URL", "http://elsewhere:81/below")
    monkeypatch.setenv("DEEPSIMBAD_API_KEY", "from-environment")
    recorder = Recorder(httpx2.Response(200, json=[]))
    with Client(transport=httpx2.MockTransport(recorder)) as service:
        assert service.domains() == ()
    assert recorder.request.url == "http://elsewhere:81/below/v1/domains"
    assert recorder.request.headers["authorization"] == "Bearer from-environment"
    with Client("http://here", "given", transport=httpx2.MockTransport(recorder)) as service:
        service.domains()
    assert recorder.request.headers["authorization"] == "Bearer given"
    assert recorder.request.url.host == "here"


def test_a_key_is_neither_sent_where_there_is_none_nor_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DEEPSIMBAD_API_KEY", raising=False)
    service, recorder = asked([])
    service.domains()
    assert "authorization" not in recorder.request.headers
    with pytest.raises(InvalidArgumentError) as raised:
        Client("http://service", "geheim\n")
    assert "geheim" not in str(raised.value)


def test_frames_travel_as_npz() -> None:
    service, recorder = asked({"n_new": 2, "n_replaced": 0, "n_frames": 2})
    service.admin.put_frames("d", "t", encodings=[[1.0], [2.0]], index=[0, 5], position_m=[0, 1.5])
    with np.load(BytesIO(recorder.request.content)) as sent:
        assert sorted(sent) == ["encodings", "index", "position_m"]
        assert sent["encodings"].dtype == np.float32
        assert sent["index"].tolist() == [0, 5]
    assert recorder.request.headers["content-type"] == "application/octet-stream"


def test_relevances_are_an_array() -> None:
    packed = BytesIO()
    np.save(packed, np.array([0.5, -1.0], np.float32))
    recorder = Recorder(httpx2.Response(200, content=packed.getvalue()))
    service = Client("http://service", transport=httpx2.MockTransport(recorder))
    assert service.relevances("d", ranked_landmarks=[0]).tolist() == [0.5, -1.0]
    assert recorder.request.headers["accept"] == "application/octet-stream"


@pytest.mark.parametrize("content", [b"", b"<html>", b"{}", b"\x93NUMPY\x01\x00"])
def test_something_else_answers_at_this_address(content: bytes) -> None:
    recorder = Recorder(httpx2.Response(200, content=content))
    service = Client("http://service", transport=httpx2.MockTransport(recorder))
    for call in (service.domains, lambda: service.domain("d"), lambda: service.relevances("d", encoding=[1])):
        with pytest.raises(errors.UnexpectedAnswerError, match="http://service/v1"):
            call()


def test_a_redirect_is_not_followed_with_the_key() -> None:
    recorder = Recorder(httpx2.Response(307, headers={"location": "http://evil/"}))
    service = Client("http://service", "key", transport=httpx2.MockTransport(recorder))
    with pytest.raises(errors.UnexpectedAnswerError, match="http://evil/"):
        service.domains()


@pytest.mark.parametrize("code", sorted(BY_CODE))
def test_every_code_has_its_class(code: str) -> None:
    problem = {"code": code, "detail": "what is wrong", "limit": 5}
    service, _ = asked(problem, 418)
    with pytest.raises(BY_CODE[code], match="what is wrong") as raised:
        service.health()
    assert raised.value.code == code
    assert raised.value.problem["limit"] == 5


@pytest.mark.parametrize("status", [status for status in BY_STATUS if status not in RETRIED_STATUSES])
def test_an_unheard_code_falls_back_on_the_status(status: int) -> None:
    recorder = Recorder(httpx2.Response(status, json={"code": "of_the_future"}, headers={"x-request-id": "abc"}))
    service = Client("http://service", transport=httpx2.MockTransport(recorder))
    with pytest.raises(BY_STATUS[status]) as raised:
        service.health()
    assert type(raised.value) is BY_STATUS[status]
    assert (raised.value.code, raised.value.status, raised.value.request_id) == ("of_the_future", status, "abc")
    assert "abc" in str(raised.value)


def test_the_code_words_are_those_of_the_service() -> None:
    from deepsimbad import errors as service_errors  # noqa: PLC0415

    def words(kind: type[service_errors.DeepSimbadError]) -> set[str]:
        return {kind.code}.union(*(words(below) for below in kind.__subclasses__()))

    assert set(BY_CODE) <= words(service_errors.DeepSimbadError)


def test_a_proxys_page_is_an_error_too() -> None:
    recorder = Recorder(httpx2.Response(500, content=b"<h1>oops</h1>"))
    with pytest.raises(errors.ServerError) as raised:
        Client("http://service", transport=httpx2.MockTransport(recorder)).health()
    assert raised.value.code == "http_500"


@pytest.mark.parametrize("index", range(-1, 12))
def test_what_a_traverse_has(index: int) -> None:
    present = {0, 1, 4, 5, 8}
    traverse = Traverse(name="t", n_frames=len(present), missing=((2, 3), (6, 7)))
    assert traverse.has(index) == (index in present)


def test_a_domain_without_a_map() -> None:
    service, _ = asked({"name": "d", "map_version": None, "evaluator": {"kind": "feature_l2"}})
    assert service.domain("d") == Domain(name="d", evaluator={"kind": "feature_l2"})


def test_events_of_a_job_in_both_clients() -> None:
    job = {"job_id": "1", "domain": "d", "state": "running", "progress": 0.5}
    done = job | {"state": "succeeded", "progress": 1.0}
    stream = f": ping\n\nevent: progress\ndata: {json.dumps(job)}\n\nevent: done\ndata: {json.dumps(done)}\n\n"

    def respond(request: httpx2.Request) -> httpx2.Response:
        assert request.headers["accept"] == "text/event-stream"
        return httpx2.Response(200, content=stream.encode(), headers={"content-type": "text/event-stream"})

    async def listen() -> list[str]:
        async with AsyncClient("http://service", transport=httpx2.MockTransport(respond)) as service:
            return [heard.state async for heard in service.admin.job_events("1")]

    with Client("http://service", transport=httpx2.MockTransport(respond)) as service:
        assert [heard.state for heard in service.admin.job_events("1")] == ["running", "succeeded"]
    assert asyncio.run(listen()) == ["running", "succeeded"]


def test_importing_the_client_needs_httpx2_and_pydantic_alone() -> None:
    program = (
        "import sys; before = set(sys.modules)\n"
        "import deepsimbad_client\n"
        "print(sorted({name.partition('.')[0] for name in set(sys.modules) - before}))"
    )
    printed = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, timeout=60
    ).stdout
    imported = set(ast.literal_eval(printed))
    assert {"httpx2", "pydantic"} <= imported
    assert not imported & {"numpy", "cv2", "click", "rich", "matplotlib", "deepsimbad"}


@pytest.mark.parametrize("absent", ["click", "rich", "numpy", "cv2", "matplotlib"])
def test_the_script_without_the_extra_says_what_to_install(absent: str) -> None:
    program = f"import sys; sys.modules[{absent!r}] = None\nfrom deepsimbad_client.cli import main\nmain()"
    ended = subprocess.run(
        [sys.executable, "-c", program, "domains"], check=False, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 1
    assert ended.stderr == f"{absent} not installed: pip install 'deep-simbad[replay]'\n"
