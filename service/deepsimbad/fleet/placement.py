"""Which replica a domain lives with: rendezvous hashing, so that another replica moves no domain it does not take.

A domain has two owners: a hot one is not pinned to one replica, and one that dies leaves another that answers.
"""

import re
from hashlib import blake2b
from urllib.parse import unquote

from deepsimbad.api.requests import derived_id
from deepsimbad.engine.session import DOMAIN_DIGITS, domain_digits

N_OWNERS = 2
_OF_DOMAIN = re.compile(r"/v1/domains/([^/]+)/(localizations|sessions)")
_OF_SESSION = re.compile(r"/v1/sessions/([^/]+)(/.*)?")


def owners(digits: str, n_replicas: int) -> tuple[int, ...]:
    """The replicas that a domain lives with, by the digits of its name's digest, in no order of importance."""
    weights = {
        replica: blake2b(f"{replica} {digits}".encode("utf-8", "surrogatepass")).digest()
        for replica in range(n_replicas)
    }
    return tuple(sorted(weights, key=weights.__getitem__, reverse=True)[:N_OWNERS])


def session_owners(session_id: str, n_replicas: int) -> tuple[int, ...]:
    """The owners of a session's domain, the session's own before the one that takes it over."""
    first, *rest = owners(session_id[:DOMAIN_DIGITS], n_replicas)
    is_other = blake2b(session_id[DOMAIN_DIGITS:].encode("utf-8", "surrogatepass")).digest()[0] % 2
    return (*rest, first) if is_other else (first, *rest)


def place(
    path: str, n_replicas: int, key_id: str | None = None, word: str | None = None
) -> tuple[tuple[int, ...], bool] | None:
    """The replicas that may answer a decoded path, and whether in this order; None: an administrator answers.

    Args:
        path: As it is routed.
        n_replicas: Of the fleet.
        key_id: Of the API key that is presented, if any.
        word: The idempotency key; from it and `key_id` follows the id of a session that is begun.
    """
    if path == "/v1/localizations":  # any replica asks the owners
        return tuple(range(n_replicas)), False
    if (of_session := _OF_SESSION.fullmatch(path)) is not None:
        return session_owners(of_session[1], n_replicas), True
    if (of_domain := _OF_DOMAIN.fullmatch(path)) is not None:
        domain = unquote(of_domain[1])
        digits = domain_digits(domain)
        if of_domain[2] == "sessions" and word is not None:
            session_id = digits + derived_id("session", key_id, domain, word)[DOMAIN_DIGITS:]
            return session_owners(session_id, n_replicas), True
        return owners(digits, n_replicas), False
    return None
