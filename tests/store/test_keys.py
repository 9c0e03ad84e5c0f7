"""API keys in the catalog."""

import re
import sqlite3
from datetime import timedelta

import pytest

from deepsimbad.errors import InvalidInputError, TooManyDomainsError, UnknownKeyError
from deepsimbad.store.api_key import ApiKey
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.documents import now
from deepsimbad.store.records import KeyScope

EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


def test_a_key_is_kept_without_its_secret(catalog: Catalog) -> None:
    record, key = catalog.create_key(KeyScope.ADMIN, "the operator")
    assert re.fullmatch(r"dsk_[0-9a-f]{12}_[A-Za-z0-9_-]{43}", key.text)
    assert ApiKey.parse(key.text) == key
    assert record.key_id == key.key_id
    assert (record.name, record.scope, record.secret_sha256) == ("the operator", KeyScope.ADMIN, key.secret_sha256)
    assert (record.expires_at, record.revoked_at) == (None, None)
    assert catalog.keys() == [record]
    assert key.secret not in repr(key)
    catalog.close()
    for path in catalog.data_dir.iterdir():
        if path.is_file():
            assert key.secret.encode() not in path.read_bytes(), path.name


def test_keys_differ(catalog: Catalog) -> None:
    made = [catalog.create_key(KeyScope.LOCALIZE)[1] for _ in range(20)]
    assert len({key.key_id for key in made}) == len({key.secret for key in made}) == 20
    kept = catalog.keys()
    assert [record.key_id for record in kept] == [key.key_id for key in made]


def test_a_revoked_key_stays_in_the_list(catalog: Catalog) -> None:
    record, _ = catalog.create_key(KeyScope.LOCALIZE)
    assert record.is_usable(now())
    revoked = catalog.revoke_key(record.key_id)
    assert revoked.revoked_at is not None
    assert not revoked.is_usable(now())
    assert catalog.revoke_key(record.key_id) == revoked
    assert catalog.keys() == [revoked]


@pytest.mark.parametrize("key_id", ["0123456789ab", "", "\ud800", "' OR 1=1 --", "0" * 10_000])
def test_an_unknown_key_cannot_be_revoked(catalog: Catalog, key_id: str) -> None:
    kept, _ = catalog.create_key(KeyScope.LOCALIZE)
    with pytest.raises(UnknownKeyError):
        catalog.revoke_key(key_id)
    assert catalog.keys() == [kept]


def test_a_key_expires(catalog: Catalog) -> None:
    record, _ = catalog.create_key(KeyScope.LOCALIZE, lifetime=timedelta(days=2))
    assert record.expires_at is not None
    assert record.is_usable(now())
    assert not record.is_usable(record.expires_at)
    assert record.expires_at > record.created_at


def test_what_cannot_be_a_key_is_refused(catalog: Catalog) -> None:
    for name in ("a\nb", "\ud800", "x" * 101, "\x1b[31m"):
        with pytest.raises(InvalidInputError):
            catalog.create_key(KeyScope.ADMIN, name)
    for lifetime in (timedelta(0), timedelta(days=-1), timedelta(days=9_000_000)):
        with pytest.raises(InvalidInputError):
            catalog.create_key(KeyScope.ADMIN, lifetime=lifetime)
    assert catalog.keys() == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "dsk_",
        "dsk_0123456789ab_",
        "dsk_0123456789AB_" + "a" * 43,
        "dsk_0123456789ab_" + "a" * 42 + "\n",
        "dsk_0123456789ab_" + "a" * 44,
        "dsk_0123456789ab_" + "a" * 42 + "ä",
        " dsk_0123456789ab_" + "a" * 43,
    ],
)
def test_other_text_is_no_key(text: str) -> None:
    assert ApiKey.parse(text) is None


def test_scopes(catalog: Catalog) -> None:
    assert KeyScope.ADMIN.includes(KeyScope.LOCALIZE)
    assert KeyScope.ADMIN.includes(KeyScope.ADMIN)
    assert KeyScope.LOCALIZE.includes(KeyScope.LOCALIZE)
    assert not KeyScope.LOCALIZE.includes(KeyScope.ADMIN)


def test_two_processes_see_each_others_keys(catalog: Catalog) -> None:
    with Catalog.open(catalog.data_dir) as other:
        record, _ = other.create_key(KeyScope.ADMIN)
        assert catalog.keys() == [record]
        revoked = other.revoke_key(record.key_id)
    assert catalog.keys() == [revoked]


def test_rows_that_no_release_of_ours_wrote_are_refused_by_the_schema(catalog: Catalog) -> None:
    catalog.create_key(KeyScope.ADMIN)
    with sqlite3.connect(catalog.data_dir / "catalog.sqlite") as raw, pytest.raises(sqlite3.IntegrityError):
        raw.execute("UPDATE api_key SET scope = 'root'")
    raw.close()


def test_domains_are_limited(catalog: Catalog) -> None:
    for name in ("a", "b"):
        catalog.create_domain(name, EVALUATOR, False, [1], max_domains=2)
    with pytest.raises(TooManyDomainsError) as caught:
        catalog.create_domain("c", EVALUATOR, False, [1], max_domains=2)
    assert caught.value.hints == {"max_domains": 2}
    assert not (catalog.data_dir / "domains" / "c").exists()
    _, created = catalog.create_domain("a", EVALUATOR, False, [1], max_domains=2)
    assert not created, "the same again is no new one"
    catalog.delete_domain("a")
    catalog.create_domain("c", EVALUATOR, False, [1], max_domains=2)
    catalog.create_domain("d", EVALUATOR, False, [1])
