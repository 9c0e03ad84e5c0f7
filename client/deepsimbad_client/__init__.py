"""Client of the Deep SIMBAD service.

>>> from deepsimbad_client import Client
>>> with Client("http://127.0.0.1:8000") as client:  # doctest: +SKIP
...     print(client.localize("campus", "view.jpg").belief.mode_m)
"""

from deepsimbad_client.async_client import AsyncClient
from deepsimbad_client.client import Client
from deepsimbad_client.errors import ApiError, DeepSimbadClientError
from deepsimbad_client.models import Belief, Domain, Job, Localization
from deepsimbad_client.retry import RetryPolicy

__all__ = [
    "ApiError",
    "AsyncClient",
    "Belief",
    "Client",
    "DeepSimbadClientError",
    "Domain",
    "Job",
    "Localization",
    "RetryPolicy",
]
