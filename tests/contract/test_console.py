"""The console's files and the calls it makes: a session's events, a map's coverage, domains' options."""

import json
import re
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from .conftest import RANKS, TAKES_ENCODINGS, image_body, path_of, picture, problem

FILES = Path(str(resources.files("deepsimbad") / "console"))


def test_the_page_and_all_it_names_come_from_here_under_a_strict_policy(client):
    page = client.get("/console")
    policy = dict(part.split(" ", 1) for part in page.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    names = set(re.findall(r'(?:href|src)="console/([^"]+)"', page.text))
    for script in FILES.glob("*.js"):
        names |= set(re.findall(r'from "\./([^"]+)"', script.read_text()))
    assert {"main.js", "console.css", "uplot.js", "preact.js", "sessions.js"} <= names
    for name in sorted(names):
        answer = client.get(f"/console/{name}")
        assert answer.status_code == 200, name
        assert re.match(r"text/(javascript|css)|image/svg", answer.headers["content-type"]), name
    assert client.get("/console/", follow_redirects=False).headers["location"] == "../console"
    assert client.get("/console/unknown.js").status_code == 404
    assert client.get("/console/..%2fapp.js").status_code in {404, 422}


def test_its_files_are_small_and_reach_no_other_host():
    assert sum(path.stat().st_size for path in FILES.rglob("*") if path.is_file()) < 300_000
    for path in FILES.glob("*.[!t]*"):
        text = path.read_text().replace("http://www.w3.org/2000/svg", "").replace("http://www.w3.org/1999/xlink", "")
        text = re.sub(r"/\*!.*?\*/", "", text.replace("http://www.w3.org/1998/Math/MathML", ""))
        assert "://" not in text, path.name


def test_a_report_is_shown_where_it_reaches_neither_the_key_nor_a_host(client):
    answer = client.get("/console/report.html")
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts; default-src 'none';")
    assert "allow-same-origin" not in policy
    assert "connect-src" not in policy
    assert answer.headers["x-frame-options"] == "SAMEORIGIN"


def events(client, path, **options):
    """The events of a session until it has ended: (name, id, document)."""
    rows, current = [], {}
    with client.stream("GET", f"{path}/events", **options) as stream:
        assert stream.status_code == 200, stream.read()
        for line in stream.iter_lines():
            field, _, content = line.partition(": ")
            if line:
                current[field] = content
            elif "data" in current:
                rows.append((current["event"], current.get("id"), json.loads(current["data"])))
                current = {}
    return rows


def test_a_sessions_events_are_what_its_observations_were_answered(client):
    session = client.begin()
    path = path_of(session)
    answers = [client.observe(path, action_m=2) for _ in range(3)]
    prior = client.put(f"{path}/prior", json={"position_m": 10.0, "std_m": 2.0}).json()
    assert client.delete(path).status_code == 204
    rows = events(client, path, params={"after": 0})
    names = [(name, number) for name, number, _ in rows]
    assert names == [*(("observation", number) for number in "123"), ("prior", "4"), ("done", None)]
    for answer, (_, _, event) in zip([*answers, prior], rows, strict=False):
        for document in (answer, event):
            document.pop("timings_ms", None)
        assert answer == event
    later_rows = events(client, path, headers={"Last-Event-ID": "2"})
    assert [number for _, number, _ in later_rows] == ["3", "4", None]
    assert later_rows[0][2]["belief"] == rows[2][2]["belief"]
    assert [number for _, number, _ in events(client, path)] == ["4", None], "the last one, where nobody said from when"
    problem(client.get(f"{path}/events?after=-1"), 422, "invalid_request")


def test_what_a_robot_saw_is_not_held_for_a_domain_that_keeps_no_pictures(client):
    path = client.session("seen")
    client.observe(path, image_body(picture(3)))
    assert client.get(f"{path}/view").status_code == 204


def test_events_come_while_a_session_lives(client):
    path = client.session()
    with client.stream("GET", f"{path}/events") as stream:
        lines = stream.iter_lines()
        client.post(f"{path}/observations", json=RANKS)
        assert next(line for line in lines if line.startswith("event: ")) == "event: observation"
        client.delete(path)
        assert next(line for line in lines if line.startswith("event: ")) == "event: done"


def test_coverage_names_every_map_image_and_the_worst_stretches(client):
    answer = client.get("/v1/domains/ready/coverage").json()
    description = client.get("/v1/domains/ready").json()
    n = description["n_map_images"]
    assert answer["map_version"] == description["map_version"]
    assert answer["basis"] in {"one_season", "two_seasons"}
    chance = np.array(answer["chance"])
    assert len(answer["route_position_m"]) == chance.size == len(answer["x_m"]) == n
    assert answer["x_m"][3] is None
    assert ((chance >= 0) & (chance <= 1)).all()
    means = [stretch["chance"] for stretch in answer["stretches"]]
    assert means == sorted(means)
    for stretch in answer["stretches"]:
        chances = chance[stretch["first_map_image"] : stretch["last_map_image"] + 1]
        assert stretch["chance"] == pytest.approx(chances.mean(), abs=1e-3)
        assert chances.mean() < chance.mean()


def test_landmarks_are_known_by_the_frames_they_began_as(client):
    description = client.get("/v1/domains/seen").json()
    answer = client.get("/v1/domains/seen/landmarks").json()
    columns = [answer[name] for name in ("n_map_images", "map_image", "frame", "drive")]
    assert {len(column) for column in columns} == {description["n_landmarks"]}
    assert sum(answer["n_map_images"]) == description["n_map_images"] * description["list_length"]
    assert sorted(answer["map_image"]) == list(range(description["n_map_images"])), "of its own drive, all of them"
    assert set(answer["drive"]) == {"drive"}


def test_what_a_domain_shows_may_be_changed_and_nothing_else(client, domain):
    path, body = f"/v1/admin/domains/{domain}", TAKES_ENCODINGS
    assert client.get(f"/v1/domains/{domain}").json()["thumbnails"] is False
    anchor = {"lat_deg": 42.29, "lon_deg": -83.71}
    answer = client.put(path, json={**body, "thumbnails": True, "anchor": anchor})
    assert (answer.status_code, answer.json()["thumbnails"]) == (200, True)
    assert answer.json()["anchor"] == {**anchor, "bearing_deg": 0.0, "height_m": 0.0}
    document = client.put(path, json=body).json()
    assert document["thumbnails"] is True, "what is not named stays"
    assert client.put(path, json={**body, "anchor": None}).json()["anchor"] is None
    problem(client.put(path, json={**body, "closed": True, "thumbnails": False}), 409, "domain_differs")
    assert client.get(f"/v1/domains/{domain}").json()["thumbnails"] is True
    problem(client.put(path, json={**body, "anchor": {"lat_deg": 91.0, "lon_deg": 0.0}}), 422, "invalid_request")


def test_a_geopose_where_the_domain_has_an_anchor(client, domain):
    ask = {"json": RANKS, "headers": {"Accept": "application/geopose+json"}}
    path, body = f"/v1/domains/{domain}/localizations", TAKES_ENCODINGS
    assert problem(client.post(path, **ask), 406, "not_acceptable")["reason"] == "no_anchor"
    anchor = {"lat_deg": 42.29, "lon_deg": -83.71, "bearing_deg": 90.0, "height_m": 270.0}
    assert client.put(f"/v1/admin/domains/{domain}", json={**body, "anchor": anchor}).status_code == 200
    answer = client.post(path, **ask)
    assert answer.headers["content-type"] == "application/geopose+json"
    place = client.post(path, json=RANKS).json()["belief"]["top"][0]
    # y leads east, x south: a metre of each, by the meridian and the parallel there
    metre_lat, metre_lon = 1 / 111_078.9, 1 / 82_473.9
    position = answer.json()["position"]
    assert position["lat"] == pytest.approx(42.29 - metre_lat * place["x_m"], abs=2e-7)
    assert position["lon"] == pytest.approx(-83.71 + metre_lon * place["y_m"], abs=2e-7)
    assert position["h"] == 270.0
    # The route leads along (2, -1): by the anchor's turn 2 south and 1 west
    assert answer.json()["angles"] == {"yaw": pytest.approx(-116.565, abs=1e-3), "pitch": 0.0, "roll": 0.0}
    problem(client.post("/v1/domains/seen/localizations", **ask), 406, "not_acceptable")
