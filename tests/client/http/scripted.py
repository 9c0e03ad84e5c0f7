"""A service that answers by script, behind httpx2's MockTransport."""

import httpx2

from deepsimbad_client import Client, RetryPolicy

POLICY = RetryPolicy(attempts=4, base_s=1.0, max_backoff_s=3.0, max_retry_after_s=30.0)
JOB = {"job_id": "j", "domain": "d", "state": "running"}
BELIEF = {
    "mean_m": 1.0,
    "mode_m": 2.0,
    "std_m": 0.5,
    "credible_95_m": [9.0, 1.0],
    "entropy_bits": 2.0,
    "off_route": 0.0,
    "histogram": {"edges_m": [0.0, 1.0], "mass": [1.0]},
    "top": [{"map_image": 3, "route_position_m": 2.0, "x_m": None, "y_m": None, "mass": 0.5}],
}
STATE = {"session_id": "s", "domain": "d", "map_version": 1, "n_observations": 1, "belief": BELIEF}
LOCALIZATION = {
    "map_version": 7,
    "timings_ms": {"total": 1.5},
    "belief": BELIEF,
    "retrieval": [{"map_image": 3, "route_position_m": 2.0, "relevance": 1.25}],
    "next_best_view": None,
}


def answer(status, document=None, **headers):
    fields = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx2.Response(status, json=document, headers=fields)


class Script:
    """Answers with one outcome after the other, the last of them for ever, and records the requests."""

    def __init__(self, *outcomes):
        self.outcomes = list(outcomes)
        self.requests: list[httpx2.Request] = []
        self.slept: list[float] = []

    def __call__(self, request):
        self.requests.append(request)
        outcome = self.outcomes.pop(0) if len(self.outcomes) > 1 else self.outcomes[0]
        if isinstance(outcome, httpx2.Response):
            return outcome
        raise outcome("scripted", request=request)

    def client(self, url="http://service/", key=None, **options):
        arguments = {"retry": POLICY, "sleep": self.slept.append, "jitter": lambda: 1.0, **options}
        return Client(url, key, transport=httpx2.MockTransport(self), **arguments)
