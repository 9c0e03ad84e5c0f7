"""One acknowledged observation passes through few files and functions of the project."""

import sys
import threading
from pathlib import Path

import httpx2

import deepsimbad

from .conftest import RANKS, service

MOST_FILES, MOST_FUNCTIONS = 25, 117
PROJECT = str(Path(deepsimbad.__file__).parent)


class Profile:
    """Notes the project's functions that are called, in every thread that is started after it was hooked in."""

    def __init__(self):
        self.is_on = False
        self.called = set()

    def __call__(self, frame, event, _argument):
        if self.is_on and event == "call" and frame.f_code.co_filename.startswith(PROJECT):
            self.called.add(frame.f_code)

    async def of_an_observation(self, app):
        """Hear an observation of a session from its request to its answer."""
        async with httpx2.AsyncClient(transport=httpx2.ASGITransport(app), base_url="http://robot") as robot:
            session = await robot.post("/v1/domains/ready/sessions", json={})
            path = f"/v1/sessions/{session.json()['session_id']}/observations?action_m=2"
            for _ in range(3):
                assert (await robot.post(path, json=RANKS)).status_code == 200
            functions = []
            for number in (4, 5, 6):  # what happens every second may happen beside one of them
                old_profile, self.is_on, self.called = sys.getprofile(), True, set()
                sys.setprofile(self)
                try:
                    answer = await robot.post(path, json=RANKS)
                finally:
                    self.is_on = False
                    sys.setprofile(old_profile)
                assert (answer.status_code, answer.json()["n_observations"]) == (200, number)
                functions.append(self.called)
            self.called = min(functions, key=len)


def test_an_observation_passes_through_few_files_and_functions(tmp_path):
    profile = Profile()
    threading.setprofile(profile)
    try:
        with service(tmp_path) as client:
            client.make_ready_domain("ready")
            assert client.portal is not None
            client.portal.call(profile.of_an_observation, client.app)
    finally:
        threading.setprofile(None)
    functions = sorted(f"{Path(code.co_filename).relative_to(PROJECT)}: {code.co_qualname}" for code in profile.called)
    files = sorted({function.partition(":")[0] for function in functions})
    assert len(files) <= MOST_FILES, f"{len(files)}: {files}"
    assert len(functions) <= MOST_FUNCTIONS, f"{len(functions)}: {functions}"
