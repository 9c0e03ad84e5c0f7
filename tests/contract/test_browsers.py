"""What browsers are told: headers on every answer, other origins where set, and a page that needs no other host."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope

from .conftest import small_settings

ORIGIN = "https://map.example.org"
EVERYWHERE = {
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "cross-origin-resource-policy": "same-origin",
}


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/healthz"),
        ("GET", "/v1/domains/ready"),
        ("GET", "/v1/domains/unknown"),
        ("GET", "/no/such/path"),
        ("PATCH", "/v1/domains"),
        ("GET", "/v1/domains/%00"),
        ("GET", "/openapi.json"),
        ("HEAD", "/readyz"),
    ],
)
def test_every_answer_carries_them_once(client: TestClient, method: str, path: str) -> None:
    answer = client.request(method, path)
    for name, value in EVERYWHERE.items():
        assert answer.headers.get_list(name) == [value], name


def test_a_map_file_may_be_kept_by_who_asked_for_it(client: TestClient) -> None:
    place = "/v1/admin/domains/ready/maps/1/file"
    answer = client.get(place)
    assert answer.status_code == 200
    again = client.get(place, headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304
    for each in (answer, again):
        assert each.headers.get_list("cache-control") == ["private, no-cache"]
        assert each.headers["x-content-type-options"] == "nosniff"


def test_our_own_fault_carries_them_too(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    app: Any = client.app

    def broken(*_: Any) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(app.state.services.catalog, "domains", broken)
    answer = client.get("/v1/domains")
    assert answer.status_code == 500
    assert EVERYWHERE.items() <= dict(answer.headers).items()


def test_head_where_load_balancers_ask(client: TestClient) -> None:
    for path in ("/healthz", "/readyz"):
        answer = client.head(path)
        assert (answer.status_code, answer.headers["content-type"]) == (200, "application/json"), path
    answer = client.head("/v1/domains")
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET")


# The page of the documentation


def test_the_page_loads_nothing_from_elsewhere(client: TestClient) -> None:
    page = client.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert "//" not in page.text
    policy = dict(each.split(" ", 1) for each in page.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert re.findall(r"<script(?! src=)|\son\w+=|<style", page.text) == [], "such a policy runs none of these"
    loaded = re.findall(r'(?:src|href)="(docs/[^"]+)"', page.text)
    assert len(loaded) == 3
    for path in loaded:
        answer = client.get(f"/{path}")
        assert answer.status_code == 200
        kind = "text/css" if path.endswith(".css") else "text/javascript"
        assert answer.headers["content-type"].startswith(kind)
        assert answer.headers.get_list("cache-control") == ["public, max-age=3600"]
    assert "SwaggerUIBundle" in client.get("/docs/swagger-ui-bundle.js").text
    start = client.get("/docs/start.js").text
    assert client.get("/" + re.findall(r'url: "([^"]+)"', start)[0]).json()["info"]["title"] == "Deep SIMBAD"
    assert "validatorUrl: null" in start


@pytest.mark.parametrize("name", ["redoc.standalone.js", "..%2f__init__.py", "%2e%2e", "core.py", "x"])
def test_no_other_file_is_served(client: TestClient, name: str) -> None:
    assert client.get(f"/docs/{name}").status_code in {404, 422}


# Other origins


@pytest.fixture
def crossed(tmp_path: Path) -> Iterator[TestClient]:
    with Catalog.open(tmp_path) as catalog:
        _, key = catalog.create_key(KeyScope.ADMIN)
    with TestClient(create_app(small_settings(tmp_path, cors_origins=(ORIGIN,)))) as client:
        client.cookies.clear()
        client.headers["Origin"] = ORIGIN
        client.headers["X-Test-Key"] = key.text
        yield client


def preflight(client: TestClient, origin: str, method: str = "PUT") -> Any:
    asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": "authorization,content-type"}
    return client.options("/v1/admin/domains/a", headers={"Origin": origin, **asked})


def test_without_the_setting_no_origin_is_let_in(client: TestClient) -> None:
    for answer in (client.get("/v1/domains", headers={"Origin": ORIGIN}), preflight(client, ORIGIN)):
        assert (answer.status_code, answer.json()["code"]) == (403, "foreign_host")
        assert not [name for name in answer.headers if name.startswith("access-control")]


def test_a_preflight_needs_no_key(crossed: TestClient) -> None:
    answer = preflight(crossed, ORIGIN)
    assert answer.status_code == 200
    assert answer.headers["access-control-allow-origin"] == ORIGIN
    assert "PUT" in answer.headers["access-control-allow-methods"]
    allowed = answer.headers["access-control-allow-headers"].lower()
    assert {"authorization", "x-api-key", "content-type", "idempotency-key"} <= set(re.split(r",\s*", allowed))
    assert "access-control-allow-credentials" not in answer.headers
    assert EVERYWHERE.items() <= dict(answer.headers).items()


def test_the_call_itself_needs_one(crossed: TestClient) -> None:
    refused = crossed.get("/v1/domains")
    assert refused.status_code == 401
    assert refused.headers["access-control-allow-origin"] == ORIGIN, "or the page could not read why"
    answer = crossed.get("/v1/domains", headers={"Authorization": f"Bearer {crossed.headers['x-test-key']}"})
    assert answer.status_code == 200
    assert answer.headers["access-control-allow-origin"] == ORIGIN
    shown = set(re.split(r",\s*", answer.headers["access-control-expose-headers"]))
    assert {"X-Request-ID", "Retry-After", "Location"} <= shown


def test_another_origin_is_not_let_in(crossed: TestClient) -> None:
    for origin in ("https://evil.example.org", f"{ORIGIN}.evil.org", "null", ORIGIN.upper(), ORIGIN.replace("s:", ":")):
        assert preflight(crossed, origin).status_code == 400
        assert "access-control-allow-origin" not in crossed.get("/healthz", headers={"Origin": origin}).headers
