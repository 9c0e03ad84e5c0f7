"""The requests on the wire, and the reading of the answers."""

import itertools
import json
import sys
from io import BytesIO, StringIO

import cv2
import httpx2
import numpy as np
import pydantic
import pytest

from deepsimbad import __main__ as service_script
from deepsimbad import errors as service_errors
from deepsimbad_client import Client, RetryPolicy, errors
from deepsimbad_client import cli as client_script
from deepsimbad_client.errors import BY_CODE, BY_STATUS, InvalidArgumentError
from deepsimbad_client.http import RETRIED_STATUSES, media_type_of, observation
from deepsimbad_client.http.models import Job, Localization
from deepsimbad_client.http.wire import http_settings

from .scripted import JOB, LOCALIZATION, STATE, Script, answer

JOBS = [{**JOB, "job_id": f"j{number}"} for number in range(7)]


def test_localize_reads_the_whole_answer_and_what_it_does_not_know_yet():
    script = Script(answer(200, LOCALIZATION | {"of_the_future": [1]}))
    place = script.client().localize("campus", b"\x89PNG\r\n\x1a\n...", shortlist=4)
    assert (place.map_version, place.belief.credible_95_m, place.retrieval[0].relevance) == (7, (9.0, 1.0), 1.25)
    assert place.belief.top[0].x_m is None
    assert (place.model_extra or {})["of_the_future"] == [1]
    (request,) = script.requests
    assert request.url == "http://service/v1/domains/campus/localizations?shortlist=4"
    assert request.headers["content-type"] == "image/png"
    with pytest.raises(pydantic.ValidationError):
        place.map_version = 8  # type: ignore[misc]


@pytest.mark.parametrize(
    ("form", "body"),
    [
        ({"ranked_landmarks": (4, 2)}, {"ranked_landmarks": [4, 2]}),
        ({"ranked_landmarks": np.array([4, 2], np.uint16)}, {"ranked_landmarks": [4, 2]}),
        ({"dissimilarities": np.array([0.5], np.float32)}, {"dissimilarities": [0.5]}),
        ({"encoding": [1.0]}, {"encoding": [1.0]}),
        ({"ranked_landmarks": list(np.array([4, 2]))}, {"ranked_landmarks": [4, 2]}),
        ({"encoding": tuple(np.array([0.5, 1], np.float32))}, {"encoding": [0.5, 1.0]}),
        (
            {"objects": [{"label": "car", "box": list(np.eye(4, dtype=np.float32)[3]), "score": np.float32(0.5)}]},
            {"objects": [{"label": "car", "box": [0, 0, 0, 1], "score": 0.5}]},
        ),
    ],
)
def test_what_a_robot_encodes_itself_travels_as_json(form, body):
    script = Script(answer(200, LOCALIZATION))
    script.client().localize("campus", **form)
    assert json.loads(script.requests[0].content) == body
    assert script.requests[0].headers["content-type"] == "application/json"


def test_what_can_never_be_sent_is_refused_here(tmp_path):
    images = ({"image": b"\xff\xd8\xff", "encoding": [1.0]}, {"image": b"GIF89a"})
    numbers = ({"dissimilarities": [float("nan")]}, {"encoding": np.array([np.inf])}, {"ranked_landmarks": [object()]})
    numbers += ({"encoding": [np.float32("nan")]}, {"objects": 5})
    for form in ({}, *images, *numbers):
        with pytest.raises(InvalidArgumentError):
            observation(**form)
    with pytest.raises(errors.BrokenFrameError, match=r"no\.jpg"):
        observation(tmp_path / "no.jpg")
    image_of_words = {
        "int": 3,
        "reads text": StringIO("a"),
        r"2, 2, 4": np.zeros((2, 2, 4), np.uint8),
        "float64": np.zeros((2, 2)),
    }
    for says, image in image_of_words.items():
        with pytest.raises(InvalidArgumentError, match=says):
            observation(image)


def test_an_image_may_be_bytes_a_path_an_open_file_or_pixels(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    body = cv2.imencode(".png", pixels)[1].tobytes()
    path = tmp_path / "view.png"
    path.write_bytes(body)
    with path.open("rb") as file:
        images = [
            body,
            bytearray(body),
            memoryview(body),
            path,
            str(path),
            BytesIO(body),
            file,
            pixels,
            pixels[..., ::1],
        ]
        views = [observation(image) for image in images]
    assert {(view.body, view.headers["Content-Type"]) for view in views} == {(body, "image/png")}
    grey = observation(pixels[..., 0])
    assert np.array_equal(cv2.imdecode(np.frombuffer(grey.body, np.uint8), cv2.IMREAD_UNCHANGED), pixels[..., 0])


def test_a_proxy_is_not_asked_for_this_machine_and_named_for_others(monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://user:geheim@127.0.0.1:9")
    monkeypatch.setenv("http_proxy", "http://user:geheim@127.0.0.1:9")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    for url, is_proxied in (
        ("http://127.0.0.1:1", False),
        ("http://localhost:1", False),
        ("http://robots.invalid", True),
    ):
        with Client(url, retry=RetryPolicy(attempts=1)) as client, pytest.raises(errors.TransportError) as raised:
            client.domains()
        assert ("by the proxy http://127.0.0.1:9 of the environment" in str(raised.value)) == is_proxied
        assert "geheim" not in str(raised.value)


def test_only_plain_http_to_this_machine_goes_unverified():
    urls = ("http://127.0.0.1:1", "https://127.0.0.1:1", "http://robots.example", "https://robots.example")
    assert [http_settings(url, None, httpx2.Timeout(1)).get("verify", True) for url in urls] == [
        False,
        True,
        True,
        True,
    ]


def test_media_type_of():
    types = {b"\xff\xd8\xff\xe0": "image/jpeg", b"\x89PNG\r\n\x1a\n": "image/png", b"II*\0": "image/tiff"}
    types |= {b"MM\0*": "image/tiff", b"RIFF\n\0\0\nWEBPVP8 ": "image/webp", b"RIFF\0\0\0\0WAVE": None, b"": None}
    assert {body: media_type_of(body) for body in types} == types


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a b", "-a", "é", "a" * 65, "a\n"])
def test_a_name_that_could_leave_its_place_in_the_address(name):
    with pytest.raises(InvalidArgumentError, match="letters"):
        Client("http://service").domain(name)


def test_address_and_key_from_the_environment(monkeypatch):
    for url in ("service:8000", "ftp://service", "http://", "//service", "http://:::"):
        with pytest.raises(InvalidArgumentError, match="is no address"):
            Client(url)
    script = Script(answer(200, []))
    with pytest.raises(InvalidArgumentError) as raised:
        script.client(key="geheim\n")
    assert "geheim" not in str(raised.value)
    monkeypatch.delenv("DEEPSIMBAD_API_KEY", raising=False)
    script.client().domains()
    monkeypatch.setenv("DEEPSIMBAD_URL", "http://elsewhere:81/below")
    monkeypatch.setenv("DEEPSIMBAD_API_KEY", "from-environment")
    with script.client(None) as client:
        assert client.domains() == ()
    script.client("http://here/v1/", "given").domains()
    bare, environment, explicit = script.requests
    assert "authorization" not in bare.headers
    assert environment.url == "http://elsewhere:81/below/v1/domains?limit=200"
    assert environment.headers["authorization"] == "Bearer from-environment"
    assert (explicit.url, explicit.headers["authorization"]) == ("http://here/v1/domains?limit=200", "Bearer given")


def test_arrays_travel_as_npz_and_npy():
    packed = BytesIO()
    np.save(packed, np.array([0.5, -1.0], np.float32))
    stored = answer(200, {"n_new": 2, "n_replaced": 0, "n_frames": 2})
    script = Script(stored, httpx2.Response(200, content=packed.getvalue()))
    client = script.client()
    client.admin.put_frames("d", "t", encodings=[[1.0], [2.0]], index=[0.0, 5.0], position_m=[0, 1.5])
    assert client.relevances("d", ranked_landmarks=[0]).tolist() == [0.5, -1.0]
    frames, relevances = script.requests
    with np.load(BytesIO(frames.content)) as arrays:
        assert sorted(arrays) == ["encodings", "index", "position_m"]
        assert arrays["encodings"].dtype == np.float32
        assert arrays["index"].dtype == np.int64
        assert arrays["index"].tolist() == [0, 5]
    assert frames.headers["content-type"] == relevances.headers["accept"] == "application/octet-stream"


def test_an_index_that_is_no_whole_number_is_not_cut_to_one():
    script = Script(answer(200, {"n_new": 1, "n_replaced": 0, "n_frames": 1}))
    script.client().admin.put_frames("d", "t", encodings=[[1.0]], index=[0.5], position_m=[0])
    with np.load(BytesIO(script.requests[0].content)) as arrays:
        assert arrays["index"].tolist() == [0.5], "which the service refuses"


@pytest.mark.parametrize("content", [b"", b"<html>", b"{}", b"\x93NUMPY\x01\x00"])
def test_something_else_answers_at_this_address(content):
    client = Script(httpx2.Response(200, content=content)).client()
    for call in (client.domains, lambda: client.domain("d"), lambda: client.relevances("d", encoding=[1])):
        with pytest.raises(errors.UnexpectedAnswerError, match="http://service/v1"):
            call()
    with pytest.raises(errors.UnexpectedAnswerError, match="http://evil/"):  # not followed with the key
        Script(answer(307, location="http://evil/")).client(key="key").domains()
    with pytest.raises(errors.ServerError) as raised:
        Script(httpx2.Response(500, content=b"<h1>oops</h1>")).client().health()
    assert raised.value.code == "http_500"


def test_every_code_has_its_class_and_is_the_services():
    def words(kind):
        return {kind.code}.union(*(words(below) for below in kind.__subclasses__()))

    assert len(BY_CODE) > 10
    assert set(BY_CODE) <= words(service_errors.DeepSimbadError)
    for code, kind in BY_CODE.items():
        with pytest.raises(kind, match="what is wrong") as raised:
            Script(answer(418, {"code": code, "detail": "what is wrong", "limit": 5})).client().health()
        assert raised.value.code == code
        assert raised.value.problem["limit"] == 5


@pytest.mark.parametrize("status", [status for status in BY_STATUS if status not in RETRIED_STATUSES])
def test_an_unheard_code_falls_back_on_the_status(status):
    with pytest.raises(BY_STATUS[status]) as raised:
        Script(answer(status, {"code": "of_the_future"}, x_request_id="abc")).client().health()
    assert type(raised.value) is BY_STATUS[status]
    assert (raised.value.code, raised.value.status, raised.value.request_id) == ("of_the_future", status, "abc")
    assert "abc" in str(raised.value)


def shelf(request):
    """Answers with pages of three jobs, whatever length is asked for."""
    first = int(request.url.params.get("after", "jobs-0").removeprefix("jobs-"))
    next_page = f"jobs-{first + 3}" if first + 3 < len(JOBS) else None
    return httpx2.Response(200, json={"jobs": JOBS[first : first + 3], "next": next_page})


def test_a_list_is_read_to_its_end():
    pages: list[dict[str, str]] = []

    def note(request):
        pages.append(dict(request.url.params))
        return shelf(request)

    with Client("http://service", transport=httpx2.MockTransport(note)) as client:
        assert [job.job_id for job in client.admin.jobs("d")] == [job["job_id"] for job in JOBS]
        assert [page.get("after") for page in pages] == [None, "jobs-3", "jobs-6"]
        assert {page["domain"] for page in pages} == {"d"}


@pytest.mark.parametrize("document", [{"jobs": JOBS[:2]}, {"jobs": JOBS[:2], "next": None}, JOBS[:2]])
def test_a_list_that_names_no_next_page_is_whole_as_those_of_an_older_service(document):
    assert len(Script(answer(200, document)).client().admin.jobs()) == 2


@pytest.mark.parametrize("document", [{}, {"next": None}, {"jobs": 7, "next": None}, {"jobs": [{}], "next": None}])
def test_what_is_no_list_is_said(document):
    with pytest.raises(errors.UnexpectedAnswerError):
        Script(answer(200, document)).client().admin.jobs()


@pytest.mark.parametrize("is_named", [False, True])
def test_every_answer_knows_its_request_which_the_caller_may_name(is_named):
    plan, observed = {"planner": "informed", "action_m": 2.0}, {**LOCALIZATION, "n_observations": 1}
    documents = [LOCALIZATION, STATE, observed, plan, JOB]
    names = (f"robot.{number}" for number in itertools.count())
    script = Script(*(answer(200, document, x_request_id=f"r{n}") for n, document in enumerate(documents)))
    with script.client(request_id=names.__next__ if is_named else None) as client:
        place = client.localize("d", ranked_landmarks=[0])
        session = client.session("d", keep=True)
        answers = [place, session.opened, session.observe(ranked_landmarks=[0]), session.next_best_view()]
        answers.append(client.admin.job("j"))
    assert [reply.request_id for reply in answers if reply is not None] == ["r0", "r1", "r2", "r3", "r4"]
    ids = [request.headers.get("x-request-id") for request in script.requests]
    assert ids == [f"robot.{n}" if is_named else None for n in range(5)]
    assert Script(answer(200, JOB)).client().admin.job("j").request_id is None


def test_every_try_has_an_id_of_its_own_and_the_error_tells_the_last():
    names = itertools.count()
    script = Script(answer(503, {}, x_request_id="t0"), answer(404, {}, x_request_id="t1"))
    with script.client(request_id=lambda: f"t{next(names)}") as client, pytest.raises(errors.NotFoundError) as raised:
        client.domain("gone")
    assert [request.headers["x-request-id"] for request in script.requests] == ["t0", "t1"]
    assert raised.value.request_id == "t1"
    for name in ("", "a b", "ä", "x\r\ny: z", "x" * 65):  # the service would not take it
        with pytest.raises(InvalidArgumentError, match="cannot name a request"):
            script.client(request_id=lambda name=name: name).domains()
    assert len(script.requests) == 2


def test_a_requests_id_is_no_part_of_what_was_answered():
    answer_of_r1, equal_answer = Localization.model_validate(LOCALIZATION), Localization.model_validate(LOCALIZATION)
    assert answer_of_r1.answering("r1").request_id == "r1"
    assert equal_answer.request_id is None
    assert answer_of_r1 == equal_answer
    assert answer_of_r1.model_dump() == equal_answer.model_dump()
    assert "r1" not in answer_of_r1.model_dump_json() + repr(answer_of_r1)
    assert Job.model_validate({**JOB, "_request_id": "theirs", "request_id": "theirs"}).request_id is None


# The scripts themselves, which load their commands late


@pytest.mark.parametrize("absent", ["click", "rich", "numpy", "cv2", "matplotlib"])
def test_the_script_without_the_extra_says_what_to_install(absent, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, absent, None)
    with pytest.raises(SystemExit) as end:
        client_script.main()
    assert end.value.code == 1
    assert capsys.readouterr().err == f"{absent} not installed: pip install 'deep-simbad[replay]'\n"


@pytest.mark.parametrize(
    ("script", "loads", "says"),
    [
        (service_script, "deepsimbad.cli", "cancelled\n"),
        (client_script, "deepsimbad_client.commands", "deepsimbad-client: cancelled\n"),
    ],
)
def test_a_ctrl_c_while_a_command_is_loaded_is_no_stack(script, loads, says, monkeypatch, capsys):
    class CtrlC:
        def find_spec(self, name, path=None, target=None):
            if name == loads:
                raise KeyboardInterrupt

    monkeypatch.setenv("OPENBLAS_THREAD_TIMEOUT", "16")
    monkeypatch.delitem(sys.modules, loads)
    monkeypatch.setattr(sys, "meta_path", [CtrlC(), *sys.meta_path])
    with pytest.raises((SystemExit, KeyboardInterrupt)) as end:  # the second would end the tests too
        script.main()
    assert (end.type, end.value.args, capsys.readouterr().err) == (SystemExit, (130,), says)
