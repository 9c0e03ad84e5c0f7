"""Nobody's first request waits for a kernel: all that the default path runs are ready when the service is."""

import json
import subprocess
import sys

import numpy as np

from .conftest import DIM, service

FIRST_REQUESTS = """
import importlib, json, pkgutil, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
import deepsimbad.core
from tests.contract.conftest import service

def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("deepsimbad.")]
    kernels = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {f"{kernel.py_func.__name__}{signature}" for kernel in kernels for signature in kernel.signatures}

for module in pkgutil.iter_modules(deepsimbad.core.__path__):
    importlib.import_module(f"deepsimbad.core.{module.name}")
with service(Path(sys.argv[1])) as client:
    ready = compiled()
    encoding = {"encoding": [0.1] * 8}
    views = [{"ranked_landmarks": list(range(40))}, {"ranked_landmarks": [3, 1]}, encoding, encoding]
    answers = []
    for domain in ("even", "uneven"):
        session = client.post(f"/v1/domains/{domain}/sessions", json={"start_position_m": 30}).json()["session_id"]
        path = f"/v1/sessions/{session}/observations?action_m=2"
        answers += [client.post(path, json=body) for body in views]
        answers += [client.post(f"/v1/domains/{domain}/localizations", json=body) for body in views]
        answers += [client.get(f"/v1/sessions/{session}/belief")]
    print(json.dumps({"statuses": [answer.status_code for answer in answers], "late": sorted(compiled() - ready)}))
"""


def test_no_kernel_is_compiled_after_the_service_is_ready(tmp_path):
    """The maps have learnt from two seasons, and their images stand at equal distances and not, so that all run."""
    random = np.random.default_rng(3)
    places = random.normal(size=(80, DIM))
    with service(tmp_path) as client:
        for domain, position_m in (("even", np.arange(80.0)), ("uneven", np.arange(80.0) ** 1.05)):
            client.make_domain(domain)
            for season in ("summer", "winter"):
                encodings = (places + 0.1 * random.normal(size=places.shape)).astype(np.float32)
                client.upload(domain, season, encodings, position_m)
            seasons = {"training_traverse": "summer", "landmark_traverse": "winter", "same_route": True}
            job = client.remap(domain, **seasons, n_landmarks=40, training_episodes=20)
            assert job["result"]["metrics"]["second_season"]["accepted"], job
    process = subprocess.run(
        [sys.executable, "-c", FIRST_REQUESTS, str(tmp_path)], capture_output=True, text=True, check=True
    )
    answers = json.loads(process.stdout)
    assert (set(answers["statuses"]), answers["late"]) == ({200}, [])
