"""A small service that keeps sessions, behind httpx2's MockTransport, and recordings to drive against it."""

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from deepsimbad_client import Client, RetryPolicy
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.recordings.sources import open_source

N_IMAGES = 150
ACTIONS_M = tuple(float(metres) for metres in range(1, 11))


@dataclass
class FakeSession:
    mass: np.ndarray
    planner: str
    rng: np.random.Generator
    n_observations: int = 0
    answers: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    ended: bool = False


class FakeService:
    """Map images every metre; an observation `{"encoding": [p, s]}` says p metres, give or take s.

    Attributes:
        asked: Every request, as "VERB path".
        lose_answers: Called with every request that was acted on; True: its answer is lost on the way.
        doubt: What every place is given whatever is seen.
        plans: Whether next-best views are given.
    """

    def __init__(self) -> None:
        self.sessions: dict[str, FakeSession] = {}
        self.asked: list[str] = []
        self.keys: list[str] = []
        self.begun: dict[str, str] = {}
        self.lose_answers: Callable[[httpx2.Request], bool] = lambda request: False
        self.plans = True
        self.map_version = 3
        self.doubt = 0.02
        self._lock = threading.Lock()

    def client(self) -> Client:
        return Client(
            "http://service",
            retry=RetryPolicy(attempts=3),
            transport=httpx2.MockTransport(self),
            sleep=lambda seconds: None,
        )

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        with self._lock:
            self.asked.append(f"{request.method} {request.url.path}")
            response = self._route(request)
            if self.lose_answers(request):
                raise httpx2.ReadTimeout("lost", request=request)
            return response

    def _route(self, request: httpx2.Request) -> httpx2.Response:
        body = json.loads(request.content or b"{}")
        match request.method, request.url.path.strip("/").split("/")[1:]:
            case "GET", ["domains", name]:
                known = {"map_version": self.map_version, "n_map_images": N_IMAGES, "route_length_m": N_IMAGES - 1.0}
                return httpx2.Response(200, json={"name": name, "actions_m": ACTIONS_M, "input_size": None, **known})
            case "POST", ["domains", _, "localizations"]:
                if len(body["encoding"]) != 2:
                    return problem(422, "undecodable_image")
                mass = self._updated(np.full(N_IMAGES, 1 / N_IMAGES), body)
                return httpx2.Response(200, json=self._answer(mass, None, int(request.url.params["shortlist"])))
            case "POST", ["domains", _, "sessions"]:
                return self._start(body, request.headers["idempotency-key"])
            case verb, ["sessions", session_id, *rest]:
                session = self.sessions.get(session_id)
                if session is None:
                    return problem(404, "unknown_session")
                if session.ended:
                    return problem(410, "ended_session")
                return self._of_session(verb, rest, session_id, session, request, body)
        return problem(404, "not_found")

    def _start(self, body: dict[str, Any], key: str) -> httpx2.Response:
        planner = body.get("planner", "telling")
        if planner == "nonsense":
            return problem(422, "invalid_input")
        if key not in self.begun:
            self.begun[key] = f"s{len(self.sessions)}"
            rng = np.random.default_rng(body.get("seed"))
            self.sessions[self.begun[key]] = FakeSession(np.full(N_IMAGES, 1 / N_IMAGES), planner, rng)
        return httpx2.Response(201, json=self._state(self.begun[key]))

    def _of_session(
        self,
        verb: str,
        rest: list[str],
        session_id: str,
        session: FakeSession,
        request: httpx2.Request,
        body: dict[str, Any],
    ) -> httpx2.Response:
        match verb, rest:
            case "GET", ["belief"]:
                packed = BytesIO()
                np.save(packed, session.mass.astype(np.float32))
                return httpx2.Response(200, content=packed.getvalue())
            case "GET", ["next-best-view"]:
                return httpx2.Response(200, content=json.dumps(self._plan(session)).encode())
            case "PUT", ["prior"]:
                if not 0 <= body["position_m"] < N_IMAGES:
                    return problem(422, "invalid_prior")
                away = (np.arange(N_IMAGES) - body["position_m"]) / body["std_m"]
                session.mass = normal(np.exp(-0.5 * away**2))
            case "DELETE", []:
                session.ended = True
                return httpx2.Response(204)
            case "POST", ["observations"]:
                return self._observe(session, request, body)
        return httpx2.Response(200, json=self._state(session_id))

    def _observe(self, session: FakeSession, request: httpx2.Request, view: dict[str, Any]) -> httpx2.Response:
        key = request.headers["idempotency-key"]
        self.keys.append(key)
        asked = f"{request.url}{request.content!r}"
        if key in session.answers:
            was, answer = session.answers[key]
            return httpx2.Response(200, json=answer) if was == asked else problem(422, "idempotency_key_reused")
        action_m = float(request.url.params.get("action_m", 0))
        if action_m < 0 or action_m > 10 * ACTIONS_M[-1]:
            return problem(422, "invalid_move")
        if len(view["encoding"]) != 2:
            return problem(422, "undecodable_image")
        if session.n_observations:
            moved = np.zeros(N_IMAGES)
            steps = round(action_m)
            moved[steps:] = session.mass[: N_IMAGES - steps]
            if moved.sum() < 1e-3:
                return problem(422, "past_the_end")
            session.mass = normal(moved)
        session.mass = self._updated(session.mass, view)
        session.n_observations += 1
        session.answers[key] = (asked, self._answer(session.mass, session, 10))
        return httpx2.Response(200, json=session.answers[key][1])

    def _updated(self, mass: np.ndarray, view: dict[str, Any]) -> np.ndarray:
        place, spread = view["encoding"]
        return normal(mass * (np.exp(-0.5 * ((np.arange(N_IMAGES) - place) / spread) ** 2) + self.doubt))

    def _plan(self, session: FakeSession | None) -> dict[str, Any] | None:
        if session is None or not self.plans:
            return None
        planner, action_m = session.planner, 7.0
        if planner == "random":
            action_m = float(session.rng.choice(ACTIONS_M))
        elif planner.startswith("constant:"):
            action_m = float(planner.partition(":")[2])
        return {"planner": planner, "action_m": action_m, "actions": []}

    def _state(self, session_id: str) -> dict[str, Any]:
        session = self.sessions[session_id]
        answer = self._answer(session.mass, session, 10)
        return answer | {"session_id": session_id, "domain": "route", "expires_at": "2030-01-01T00:00:00Z"}

    def _answer(self, mass: np.ndarray, session: FakeSession | None, shortlist: int) -> dict[str, Any]:
        order = np.argsort(-mass, kind="stable")[:shortlist]
        places = [{"map_image": int(i), "route_position_m": float(i)} for i in order]
        low, high = np.flatnonzero(np.cumsum(mass) > 0.025)[0], np.flatnonzero(np.cumsum(mass) >= 0.975)[0]
        positive = mass[mass > 0]
        return {
            "map_version": self.map_version,
            "timings_ms": {"total": 0.5},
            "n_observations": session.n_observations if session else 1,
            "belief": {
                "mean_m": float(mass @ np.arange(N_IMAGES)),
                "mode_m": float(mass.argmax()),
                "std_m": 1.0,
                "credible_95_m": [float(low), float(high)],
                "entropy_bits": float(-(positive * np.log2(positive)).sum()),
                "off_route": 0.01,
                "histogram": {
                    "edges_m": np.linspace(0, N_IMAGES - 1, 51).tolist(),
                    "mass": mass.reshape(50, 3).sum(1).tolist(),
                },
                "top": [place | {"x_m": None, "y_m": None, "mass": mass[place["map_image"]]} for place in places],
            },
            "retrieval": [place | {"relevance": mass[place["map_image"]]} for place in places],
            "next_best_view": self._plan(session),
        }


def normal(mass: np.ndarray) -> np.ndarray:
    return np.asarray(mass / mass.sum())


def problem(status: int, code: str) -> httpx2.Response:
    return httpx2.Response(status, json={"code": code, "detail": f"refused as {code}"})


@pytest.fixture
def fake() -> FakeService:
    return FakeService()


@pytest.fixture
def drive(tmp_path: Path) -> Recording:
    """A drive of the fake service's route, a frame every metre, some views far more telling than others."""
    rng = np.random.default_rng(1)
    place = np.arange(N_IMAGES, dtype=float)
    spread = np.where(np.arange(N_IMAGES) % 7 == 0, 1.5, 25.0)
    views = np.column_stack([place + rng.normal(size=N_IMAGES) * spread / 3, spread])
    np.save(tmp_path / "drive.npy", views.astype(np.float32))
    return open_source(str(tmp_path / "drive.npy"))
