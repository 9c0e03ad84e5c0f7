"""Which replicas a domain and its sessions live with."""

from collections import Counter
from itertools import combinations

import pytest

from deepsimbad.api.requests import derived_id
from deepsimbad.engine.session import domain_digits
from deepsimbad.fleet.placement import owners, place, session_owners

DOMAINS = [f"route-{number}" for number in range(600)]


def owners_of(n_replicas):
    return {domain: owners(domain_digits(domain), n_replicas) for domain in DOMAINS}


def test_every_pair_of_replicas_has_about_as_many_domains():
    pairs = Counter(tuple(sorted(pair)) for pair in owners_of(4).values())
    assert set(pairs) == set(combinations(range(4), 2))
    assert min(pairs.values()) > 0.6 * len(DOMAINS) / 6
    assert set(owners_of(1).values()) == {(0,)}


def test_one_replica_more_takes_its_share_and_moves_nothing_else():
    of_four, of_five = owners_of(4), owners_of(5)
    moved_domains = [domain for domain in DOMAINS if set(of_four[domain]) != set(of_five[domain])]
    assert all(4 in of_five[domain] for domain in moved_domains)
    assert len(moved_domains) == pytest.approx(2 / 5 * len(DOMAINS), rel=0.2)


def test_a_session_lives_with_its_domain_half_of_them_with_each_owner():
    digits = domain_digits("ready")
    domain_owners = owners(digits, 4)
    firsts = Counter()
    for number in range(400):
        replicas = session_owners(f"{digits}{number:024x}", 4)
        assert set(replicas) == set(domain_owners)
        firsts[replicas[0]] += 1
    assert min(firsts.values()) > 150


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/v1/domains/ready/localizations", (owners(domain_digits("ready"), 4), False)),
        ("/v1/domains/ready/sessions", (owners(domain_digits("ready"), 4), False)),
        (f"/v1/sessions/{'0' * 32}", (session_owners("0" * 32, 4), True)),
        (f"/v1/sessions/{'0' * 32}/observations", (session_owners("0" * 32, 4), True)),
        ("/v1/localizations", ((0, 1, 2, 3), False)),
        ("/v1/domains/ready", None),
        ("/v1/admin/domains/ready/remaps", None),
        ("/v1/sessions", None),
        ("/readyz", None),
    ],
)
def test_a_path_tells_who_answers(path, expected):
    assert place(path, 4) == expected


def test_a_session_begins_with_the_owner_that_keeps_it():
    for word in ("a", "b", "c"):
        session_id = domain_digits("ready") + derived_id("session", "key", "ready", word)[8:]
        expected = (session_owners(session_id, 4), True)
        assert place("/v1/domains/ready/sessions", 4, "key", word) == expected
        assert place("/v1/domains/ready/localizations", 4, "key", word) == (owners(domain_digits("ready"), 4), False)


def test_text_that_is_no_name_is_placed_too():
    assert place("/v1/domains/\udcff/localizations", 2) is not None
    assert place("/v1/domains/\udcff/sessions", 2, None, "\udcff") is not None
    assert place("/v1/sessions/\udcff\udcff", 2) is not None
