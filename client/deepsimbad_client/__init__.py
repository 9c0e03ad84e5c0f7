"""Client of the Deep SIMBAD service.

>>> from deepsimbad_client import Client
>>> with Client("http://127.0.0.1:8000") as client:  # doctest: +SKIP
...     print(client.localize("campus", "view.jpg").belief.mode_m)
"""

from importlib.metadata import version

from deepsimbad_client.errors import ApiError, DeepSimbadClientError
from deepsimbad_client.http import Observation
from deepsimbad_client.http.client import AsyncClient, AsyncSession, Client, Session
from deepsimbad_client.http.download import MapFile
from deepsimbad_client.http.models import (
    Belief,
    Domain,
    Job,
    ListedSession,
    Localization,
    MapVersion,
    SessionAnswer,
    SessionState,
    Traverse,
    TruthScore,
    Whereabouts,
)
from deepsimbad_client.http.wire import RetryPolicy

__version__ = version("deep-simbad")

__all__ = [
    "ApiError",
    "AsyncClient",
    "AsyncSession",
    "Belief",
    "Client",
    "DeepSimbadClientError",
    "Domain",
    "Job",
    "ListedSession",
    "Localization",
    "MapFile",
    "MapVersion",
    "Observation",
    "RetryPolicy",
    "Session",
    "SessionAnswer",
    "SessionState",
    "Traverse",
    "TruthScore",
    "Whereabouts",
]
