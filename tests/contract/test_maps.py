"""Map versions over HTTP: how they are checked, gated, appended to, switched, downloaded and removed."""

import base64
import hashlib
import io

import numpy as np
import pytest

from .conftest import DIM, IS_FLEET, N_READY, of_one_process, problem, ready_encodings, service, wait_until

SAME_ROUTE = {"same_route": True}


def versions(client, domain):
    return {row["version"]: row for row in client.get(f"/v1/admin/domains/{domain}/maps").json()["maps"]}


def states(client, domain):
    return {version: row["state"] for version, row in versions(client, domain).items()}


def noise(seed, n=N_READY):
    return np.random.default_rng(seed).normal(size=(n, DIM))


# Made and judged


def test_the_history_tells_what_a_map_was_built_with_when_and_how_good_it_is(client, domain):
    first = versions(client, domain)[1]
    assert (first["config"]["n_landmarks"], first["config"]["training_traverse"]) == (10, "drive")
    assert (first["retired_at"], first["removed_at"], first["activated_at"][:2]) == (None, None, "20")
    check = first["metrics"]["check"]
    assert (first["metrics"]["n_map_images"], check["frames"], check["anr_active"]) == (N_READY, "held_out", None)
    client.upload(domain, "dense", ready_encodings(), np.arange(N_READY))
    check = client.remap(domain, training_traverse="dense", relevance="rrf")["result"]["metrics"]["check"]
    assert set(check) == {
        *("frames", "traverse", "n_queries", "n_left_out", "tolerance_m", "anr", "anr_active"),
        *("active_version", "gate_margin", "passed", "why", "warnings"),
    }
    assert (check["n_queries"], check["tolerance_m"], check["active_version"]) == (4, 2, 1)
    assert None not in {check["anr"], check["anr_active"]}
    history = versions(client, domain)
    assert history[2]["metrics"]["check"] == check
    assert history[1]["retired_at"] is not None


def test_more_landmarks_than_frames_are_refused_at_once_and_none_asked_for_are_as_many_as_fit(client):
    remaps = "/v1/admin/domains/fitting/remaps"
    client.make_domain("fitting")
    client.upload("fitting", "drive", ready_encodings(), np.arange(N_READY))
    client.upload("fitting", "short", noise(3, 12), np.arange(12))
    for options, n_candidates in (({}, N_READY), ({"landmark_traverse": "short"}, 12)):
        config = {"training_traverse": "drive", "n_landmarks": n_candidates + 1, **options}
        document = problem(client.post(remaps, json=config), 422, "too_few_candidates")
        assert document["n_candidates"] == n_candidates
        assert f"{n_candidates} is the most that fit" in document["detail"]
    assert client.get("/v1/admin/jobs", params={"domain": "fitting"}).json()["jobs"] == []
    assert client.make_map("fitting")["result"]["metrics"]["n_landmarks"] == N_READY


def test_versions_are_switched_and_rolled_back(client, domain):
    active = f"/v1/admin/domains/{domain}/active-map"
    job = client.remap(domain, relevance="rrf", activate=False)
    assert job["result"] == {"map_version": 2, "active": False, "metrics": job["result"]["metrics"]}

    def answer():
        document = client.localize(domain)
        return document["map_version"], document["retrieval"]

    old_answer = answer()
    assert states(client, domain) == {2: "sealed", 1: "active"}
    assert client.answer_to("PUT", active, json={"version": 2, "expected": 1})["state"] == "active"
    assert states(client, domain) == {2: "active", 1: "retired"}
    assert answer()[0] == 2
    problem(client.put(active, json={"version": 1, "expected": 1}), 409, "lost_activation")
    assert answer()[0] == 2
    assert client.put(active, json={"version": 1, "expected": 2}).status_code == 200
    assert answer() == old_answer
    assert client.put(active, json={"version": 2}).status_code == 200


def test_a_worse_map_is_sealed_but_not_activated_and_says_why(client, domain):
    client.upload(domain, "noise", noise(1), 2.0 * np.arange(N_READY))
    client.upload(domain, "day", ready_encodings() + 0.01, 2.0 * np.arange(N_READY))
    config = {"training_traverse": "noise", "check_traverse": "day", "gate_margin": 1}
    job = client.remap(domain, **config)
    assert (job["state"], job["result"]["active"], job["config"]["gate_margin"]) == ("succeeded", False, 1)
    check = job["result"]["metrics"]["check"]
    assert check["passed"] is False
    assert "more than 1 above" in check["why"]
    assert states(client, domain) == {2: "sealed", 1: "active"}
    assert client.get(f"/v1/domains/{domain}").json()["map_version"] == 1
    assert client.remap(domain, **config | {"gate_margin": None})["result"]["active"] is True


def test_frames_are_appended_to_the_map_that_serves(client, domain):
    client.upload(domain, "further", noise(2, 10), 80.0 + np.arange(10))
    assert client.delete(f"/v1/admin/domains/{domain}/traverses/drive").status_code == 204
    client.make_map(domain, training_traverse="further", append=True)
    description = client.get(f"/v1/domains/{domain}").json()
    expected = {"map_version": 2, "n_map_images": N_READY + 10, "route_length_m": 89.0}
    assert description.items() >= expected.items()
    retrieval = client.localize(domain, {"encoding": noise(2, 10)[4].tolist()})["retrieval"]
    assert retrieval[0]["route_position_m"] == 84.0
    assert versions(client, domain)[2]["config"]["appended"][0]["traverse"] == "further"


def test_what_the_map_holds_is_refused_before_it_is_appended_again(client, domain):
    """Else the frames would find their own images in the copy of the map, and any gate would open."""
    config = {"training_traverse": "drive", "append": True, "gate_margin": 2}
    answer = client.post(f"/v1/admin/domains/{domain}/remaps", json=config)
    detail = problem(answer, 422, "invalid_map_config")["detail"]
    assert "map 1, which serves, holds traverse drive already" in detail
    client.upload(domain, "again", ready_encodings(), np.arange(N_READY))
    job = client.remap(domain, **config | {"training_traverse": "again"})
    assert (job["state"], job["error"]["code"]) == ("failed", "invalid_map_config")
    assert "holds every frame of traverse again already, under another name" in job["error"]["detail"]
    assert list(versions(client, domain)) == [1]


def test_a_second_season_is_learnt_from_where_the_route_is_said_to_be_one(client, domain):
    """The drive knows x, y of its own; the other one does not."""
    client.upload(domain, "again", ready_encodings() + 0.1 * noise(1), 2.0 * np.arange(N_READY))
    client.upload(domain, "noise", noise(2), 2.0 * np.arange(N_READY))
    config = {"training_traverse": "drive", "landmark_traverse": "again", "training_episodes": 0}
    metrics_of = [client.remap(domain, **config, **options)["result"]["metrics"] for options in ({}, SAME_ROUTE)]
    unsaid_season, same_season = (metrics["second_season"] for metrics in metrics_of)
    assert [len(metrics["warnings"]) for metrics in metrics_of] == [0, 1]
    assert "look nearly the same" in metrics_of[1]["warnings"][0]
    assert (unsaid_season["accepted"], same_season["accepted"]) == (False, True)
    assert "say same_route" in unsaid_season["why"]
    assert (same_season["why"], same_season["n_pairs"]) == (None, N_READY)
    assert 0 <= same_season["significance"] < 0.001 < same_season["statistic"]
    job = client.remap(domain, **config | SAME_ROUTE | {"landmark_traverse": "noise"})
    season = job["result"]["metrics"]["second_season"]
    assert (season["accepted"], job["config"]["same_route"]) == (False, True)
    assert "agree no better" in season["why"]
    assert versions(client, domain)[4]["metrics"]["second_season"] == season


def test_landmarks_come_from_where_they_are_asked_for_or_known(client):
    """A new domain takes those of its own drive, later maps those of the active map where its relevance allows it."""
    client.make_domain("fresh")
    client.upload("fresh", "drive", ready_encodings(), 2.0 * np.arange(N_READY))
    client.upload("fresh", "again", ready_encodings() + 0.1 * noise(1), 2.0 * np.arange(N_READY))

    def landmarks_of(n_expected, **config):
        job = client.make_map("fresh", list_length=3, **config)
        domain = client.get("/v1/domains/fresh").json()
        assert domain["n_landmarks"] == n_expected
        assert job["result"]["metrics"] == versions(client, "fresh")[domain["map_version"]]["metrics"]
        model = client.get("/v1/domains/fresh/landmark-model")
        assert model.headers["etag"] == f'"{domain["landmark_model_digest"]}"'
        arrays = np.load(io.BytesIO(model.content))
        statistics = arrays["usual"].tolist() if "usual" in arrays else None
        return job["result"]["metrics"]["landmarks"], arrays["prototypes"].tolist(), statistics

    source, prototypes, statistics = landmarks_of(12, n_landmarks=12)
    assert source == "training_traverse"
    assert client.localize("fresh", {"encoding": ready_encodings()[17].tolist()})["retrieval"][0]["map_image"] == 17
    retraining = landmarks_of(12, training_traverse="again")
    assert retraining[:2] == ("active_map", prototypes)
    assert retraining[2] != statistics, "what is usual for robots that encode on board is of the drive that is mapped"
    source, *learnt = landmarks_of(9, landmark_traverse="again", n_landmarks=9)
    assert source == "landmark_traverse"
    assert landmarks_of(9) == ("active_map", *learnt)
    assert landmarks_of(9, relevance="rrf", n_landmarks=9)[0] == "training_traverse"
    assert landmarks_of(9, relevance="standardised")[0] == "active_map"
    assert landmarks_of(N_READY, relevance="composed")[0] == "training_traverse"


def test_a_closed_route_is_a_loop(client):
    client.make_ready_domain("loop", closed=True, actions_m=[2.5])
    description = client.get("/v1/domains/loop").json()
    assert (description["closed"], description["actions_m"]) == (True, [2.5])
    assert description["route_length_m"] > 2.0 * (N_READY - 1)
    client.localize("loop", {"encoding": ready_encodings()[0].tolist()})


# The file


def place_of(domain, version=1):
    return f"/v1/admin/domains/{domain}/maps/{version}/file"


def test_a_sealed_map_is_one_file_with_its_digest(client, data_dir):
    answer = client.get(place_of("ready"))
    row, body = versions(client, "ready")[1], answer.content
    digest = hashlib.sha256(body).digest()
    assert (answer.status_code, answer.headers["content-type"]) == (200, "application/vnd.sqlite3")
    assert body == (data_dir / "domains" / "ready" / "maps" / "000001.sqlite").read_bytes()
    assert len(body) == row["file_bytes"] == int(answer.headers["content-length"])
    assert digest.hex() == row["sha256"]
    assert answer.headers["etag"] == f'"sha256:{row["sha256"]}"'
    assert answer.headers["repr-digest"] == f"sha-256=:{base64.b64encode(digest).decode()}:"
    assert answer.headers["content-disposition"] == 'attachment; filename="ready-000001.sqlite"'
    assert answer.headers["accept-ranges"] == "bytes"


def test_part_of_it_can_be_asked_for(client):
    file = client.get(place_of("ready"))
    n_bytes = len(file.content)
    for byte_range, start, stop in (
        ("0-0", 0, 1),
        ("100-199", 100, 200),
        ("4096-", 4096, None),
        ("-10", -10, None),
        ("0-99999999999", 0, None),
        ("-99999999999", 0, None),
    ):
        part = client.get(place_of("ready"), headers={"Range": f"bytes={byte_range}"})
        assert (part.status_code, part.content) == (206, file.content[start:stop]), byte_range
        assert int(part.headers["content-length"]) == len(part.content)
        first = start % n_bytes
        assert part.headers["content-range"] == f"bytes {first}-{first + len(part.content) - 1}/{n_bytes}"
        assert [part.headers[name] == file.headers[name] for name in ("etag", "repr-digest")] == [True, True]
    for no_range in ("bytes=0-1,5-9", "lines=0-3", "bytes=-", "bytes=9-3", "bytes", "bytes=a-b"):
        answer = client.get(place_of("ready"), headers={"Range": no_range})
        assert (answer.status_code, answer.content) == (200, file.content), no_range
    for byte_range in (f"bytes={n_bytes}-", "bytes=-0"):
        answer = client.get(place_of("ready"), headers={"Range": byte_range})
        problem(answer, 416, "range_not_satisfiable")
        assert answer.headers["content-range"] == f"bytes */{n_bytes}"


def test_a_download_goes_on_only_with_the_same_bytes(client):
    file = client.get(place_of("ready"))
    etag = file.headers["etag"]
    for headers, status, content in (
        ({"Range": "bytes=9-", "If-Range": etag}, 206, file.content[9:]),
        ({"Range": "bytes=9-", "If-Range": '"sha256:0"'}, 200, file.content),
        ({"If-None-Match": f'"else", {etag}'}, 304, b""),
        ({"If-None-Match": '"else"'}, 200, file.content),
    ):
        answer = client.get(place_of("ready"), headers=headers)
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (status, content, etag)
        assert answer.headers.get_list("cache-control") == ["private, no-cache"], "its asker may keep it"


@pytest.mark.skipif(IS_FLEET, reason="has another, which is sent")
def test_a_damaged_file_is_not_sent(client, domain, data_dir):
    path = data_dir / "domains" / domain / "maps" / "000001.sqlite"
    path.chmod(0o644)
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 1
    path.write_bytes(body)
    document = problem(client.get(place_of(domain)), 503, "damaged_map")
    assert document["map_version"] == 1
    assert str(data_dir) not in str(document)
    path.unlink()
    problem(client.get(place_of(domain)), 503, "damaged_map")


def test_a_map_that_is_still_being_built(client):
    catalog = client.services.catalog
    version = catalog.begin_map("unmapped", {})
    try:
        detail = problem(client.get(place_of("unmapped", version)), 404, "unknown_map_version")["detail"]
        assert "still being built" in detail
        problem(client.delete(f"/v1/admin/domains/unmapped/maps/{version}"), 409, "map_in_use")
    finally:
        catalog.discard_map("unmapped", version)


# Removal


def test_an_old_version_is_removed_by_hand(client, domain, data_dir):
    place = f"/v1/admin/domains/{domain}"
    session = client.session(domain)
    client.remap(domain, relevance="rrf")
    problem(client.delete(f"{place}/maps/2"), 409, "map_in_use")  # it serves
    detail = problem(client.delete(f"{place}/maps/1"), 409, "map_in_use")["detail"]
    assert "a session lives on map 1" in detail
    assert client.observe(session)["map_version"] == 1
    assert client.delete(session).status_code == 204
    deletion = client.delete(f"{place}/maps/1")
    assert (deletion.status_code, deletion.content) == (204, b"")
    assert not (data_dir / "domains" / domain / "maps" / "000001.sqlite").exists()
    row = versions(client, domain)[1]
    assert (row["state"], row["removed_at"] is not None, row["file_bytes"] > 0) == ("retired", True, True)
    for answer in (
        client.put(f"{place}/active-map", json={"version": 1}),
        client.get(place_of(domain)),
        client.get(f"/v1/domains/{domain}/landmark-model?map_version=1"),
        client.delete(f"{place}/maps/1"),
    ):
        assert problem(answer, 410, "retired_map")["map_version"] == 1
    assert client.get(f"/v1/domains/{domain}").json()["map_version"] == 2


@of_one_process
def test_a_version_that_is_removed_while_its_file_is_read_for_a_download_is_gone(client, domain, monkeypatch):
    catalog = client.services.catalog
    map_file = catalog.map_file

    def removed_behind_it(*version):
        path = map_file(*version)
        catalog.remove_map(*version, lambda: False)
        return path

    client.remap(domain, relevance="rrf")
    monkeypatch.setattr(catalog, "map_file", removed_behind_it)
    problem(client.get(place_of(domain)), 410, "retired_map")


def test_versions_beyond_those_kept_lose_their_files(tmp_path):
    settings = {"keep_maps": 1, "session_sweep_s": 0.05}

    def files():
        return sorted(int(path.stem) for path in (tmp_path / "domains" / "route" / "maps").glob("*.sqlite"))

    with service(tmp_path, **settings) as client:
        client.make_ready_domain("route")
        session = client.session("route")
        for _ in range(2):
            client.remap("route", relevance="rrf")
        assert files() == [1, 2, 3]  # a robot lives on the first, the second is kept to roll back to
        for version in (2, 3):
            client.answer_to("PUT", "/v1/admin/domains/route/active-map", json={"version": version})
        client.remap("route", relevance="rrf")
        assert files() == [1, 3, 4]
        removed_at = versions(client, "route")[2]["removed_at"]
        assert removed_at is not None
    with service(tmp_path, **settings) as client:
        assert files() == [1, 3, 4]
        assert client.observe(session)["map_version"] == 1
        assert client.delete(session).status_code == 204
        wait_until(lambda: files() == [3, 4])
        assert versions(client, "route")[2]["removed_at"] == removed_at
        assert len(versions(client, "route")) == 4


# What a camera's seasons teach


D_SEEN = 16


def route_seen(route, drive):
    """A drive of a route in a season of its own; a season changes every fourth number of a place."""
    place = np.random.default_rng(route).normal(size=(140, D_SEEN))
    rng = np.random.default_rng(100 * route + drive)
    season_change = 4 * rng.normal(size=place.shape) * (np.arange(D_SEEN) % 4 == 0)
    return (rng.normal(size=D_SEEN) + place + season_change + 0.2 * rng.normal(size=place.shape)).astype(np.float32)


@pytest.fixture
def yard(client):
    """The domain `yard`, mapped from two seasons, and `lane`, of which one drive is there."""
    for name in ("yard", "lane"):
        client.make_domain(name)
        for drive, traverse in enumerate(("drive", "winter") if name == "yard" else ("drive",)):
            client.upload(name, traverse, route_seen(5 if name == "lane" else 4, drive), np.arange(140.0))
    options = {"training_episodes": 0, "n_landmarks": 60}
    job = client.remap("yard", landmark_traverse="winter", same_route=True, **options)
    assert job["result"]["metrics"]["second_season"]["accepted"] is True
    assert job["result"]["metrics"]["camera_of"] is None
    yield options
    for name in ("yard", "lane"):
        assert client.delete(f"/v1/admin/domains/{name}").status_code == 204


def test_what_a_cameras_seasons_teach_serves_its_other_routes(client, yard):
    def n_hits_of(**options):
        job = client.make_map("lane", **yard, **options)
        views = [{"encoding": encoding} for encoding in route_seen(5, 7).astype(float).tolist()]
        nearest = [client.localize("lane", view)["retrieval"][0]["map_image"] for view in views]
        return sum(nearest == np.arange(len(nearest))), job["result"]["metrics"]["camera_of"]

    without_camera, by_camera = n_hits_of(), n_hits_of(camera_of="yard")
    assert (without_camera[1], by_camera[1]) == (None, "yard")
    assert by_camera[0] > without_camera[0] + 5
    client.upload("lane", "winter", route_seen(5, 1), np.arange(140.0))
    seen_twice = n_hits_of(camera_of="yard", landmark_traverse="winter", same_route=True)
    assert seen_twice[1] is None, "what this route itself taught counts"


def test_a_camera_that_cannot_serve_is_named(client, yard):
    def failure_of(domain="lane", **options):
        job = client.remap(domain, **yard, **options)
        assert job["state"] == "failed", job
        return job["error"]["code"], job["error"]["detail"]

    body = {"training_traverse": "drive"}
    path = "/v1/admin/domains/lane/remaps"
    problem(client.post(path, json={**body, "camera_of": "nowhere"}), 404, "unknown_domain")
    for conflict in ({"relevance": "rrf"}, {"append": True}):
        problem(client.post(path, json={**body, "camera_of": "yard", **conflict}), 422, "invalid_map_config")
    for other, says in (("lane", "names domain lane itself"), ("seen", "another evaluator")):
        document = problem(client.post(path, json={**body, "camera_of": other}), 422, "invalid_map_config")
        assert says in document["detail"]
    assert failure_of("yard", camera_of="lane")[0] == "no_active_map"
    client.make_map("lane", **yard)
    assert "knows no second season" in failure_of("yard", camera_of="lane")[1]
    client.make_domain("short")
    client.upload("short", "drive", route_seen(5, 0)[:, :9], np.arange(140.0))
    code, says = failure_of("short", camera_of="yard")
    assert (code, "encodings of 16 numbers, not of 9" in says) == ("invalid_encoding", True)
    assert client.delete("/v1/admin/domains/yard/traverses/winter").status_code == 204
    assert "made of traverse winter, which is not in this data directory" in failure_of(camera_of="yard")[1]
