"""For browsers: headers on every answer, other origins where set, and pages that need no other host."""

import re

import pytest

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope

from .conftest import problem, service

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
    ("method", "path", "status"),
    [
        ("GET", "/healthz", 200),
        ("GET", "/v1/domains/ready", 200),
        ("GET", "/v1/domains/unknown", 404),
        ("GET", "/no/such/path", 404),
        ("PATCH", "/v1/domains", 405),
        ("GET", "/v1/domains/%00", 422),
        ("GET", "/openapi.json", 200),
        ("HEAD", "/readyz", 200),
        ("GET", "/v1/domains", 500),
    ],
)
def test_every_answer_carries_them_once(client, method, path, status, monkeypatch):
    monkeypatch.delattr(type(client.services.catalog), "domain_page")  # a fault of our own
    answer = client.request(method, path)
    assert answer.status_code == status
    for name, value in EVERYWHERE.items():
        assert answer.headers.get_list(name) == [value], name


def test_the_root_says_where_to_go(client):
    links = client.get("/").json()
    assert client.get(f"/{links['documentation']}").status_code == client.get(f"/{links['domains']}").status_code == 200
    page = client.get("/", headers={"Accept": "text/html,*/*;q=0.8"})
    assert page.headers["content-type"].startswith("text/html")
    assert set(re.findall(r'href="([^"]+)"', page.text)) == set(links.values()) - {links["name"], links["version"]}


def test_the_page_of_the_documentation_loads_nothing_from_elsewhere(client):
    page = client.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert "//" not in page.text
    policy = dict(part.split(" ", 1) for part in page.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
    assert policy["script-src"] == policy["connect-src"] == "'self'"
    assert re.findall(r"<script(?! src=)|\son\w+=|<style", page.text) == [], "such a policy runs none of these"
    paths = re.findall(r'(?:src|href)="(docs/[^"]+)"', page.text)
    assert len(paths) == 3
    for path in paths:
        answer = client.get(f"/{path}")
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/css" if path.endswith(".css") else "text/javascript")
        assert answer.headers.get_list("cache-control") == ["public, max-age=3600"]
    assert "SwaggerUIBundle" in client.get("/docs/swagger-ui-bundle.js").text
    start = client.get("/docs/start.js").text
    assert client.get("/" + re.findall(r'url: "([^"]+)"', start)[0]).json()["info"]["title"] == "Deep SIMBAD"
    assert "validatorUrl: null" in start
    for name in ("redoc.standalone.js", "..%2f__init__.py", "%2e%2e", "core.py"):
        assert client.get(f"/docs/{name}").status_code in {404, 422}, name


# Other origins


@pytest.fixture
def cors_client(tmp_path):
    """A service that lets one origin in, asked by a page of it; the header with a key."""
    with Catalog.open(tmp_path) as catalog:
        _, key = catalog.create_key(KeyScope.ADMIN)
    with service(tmp_path, cors_origins=(ORIGIN,)) as client:
        client.headers["Origin"] = ORIGIN
        yield client, {"Authorization": f"Bearer {key.text}"}


def preflight(client, origin):
    request_headers = {
        "Access-Control-Request-Method": "PUT",
        "Access-Control-Request-Headers": "authorization,content-type",
    }
    return client.options("/v1/admin/domains/a", headers={"Origin": origin, **request_headers})


def values_of(answer, header):
    return set(re.split(r",\s*", answer.headers[header].lower()))


def test_without_the_setting_no_origin_is_let_in(client):
    for answer in (client.get("/v1/domains", headers={"Origin": ORIGIN}), preflight(client, ORIGIN)):
        problem(answer, 403, "foreign_host")
        assert not [name for name in answer.headers if name.startswith("access-control")]


def test_every_call_is_documented_to_refuse_a_foreign_origin(client):
    for path, operations in client.get("/openapi.json").json()["paths"].items():
        for method, operation in operations.items():
            problem(client.request(method, path, headers={"Origin": ORIGIN}), 403, "foreign_host")
            assert "403" in operation["responses"], (method, path)


def test_a_preflight_needs_no_key_and_the_call_itself_does(cors_client):
    client, key = cors_client
    answer = preflight(client, ORIGIN)
    assert answer.status_code == 200
    assert "put" in values_of(answer, "access-control-allow-methods")
    header_names = {"authorization", "x-api-key", "content-type", "idempotency-key"}
    assert header_names <= values_of(answer, "access-control-allow-headers")
    assert "access-control-allow-credentials" not in answer.headers
    assert EVERYWHERE.items() <= dict(answer.headers).items()
    keyless, keyed = client.get("/v1/domains"), client.get("/v1/domains", headers=key)
    assert (keyless.status_code, keyed.status_code) == (401, 200)
    for response in (answer, keyless, keyed):  # or the page could not read why
        assert response.headers["access-control-allow-origin"] == ORIGIN
    assert {"x-request-id", "retry-after", "location"} <= values_of(keyed, "access-control-expose-headers")


def test_another_origin_is_not_let_in(cors_client):
    client, _ = cors_client
    for origin in ("https://evil.example.org", f"{ORIGIN}.evil.org", "null", ORIGIN.upper(), ORIGIN.replace("s:", ":")):
        assert preflight(client, origin).status_code == 400
        assert "access-control-allow-origin" not in client.get("/healthz", headers={"Origin": origin}).headers
