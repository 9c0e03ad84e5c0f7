"""Two services with the same maps, and the journals of their sessions in one place: any goes on where another was."""

import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np
import pytest

from deepsimbad.api.app import Substitutes, create_app
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.store import shared_sessions
from deepsimbad.store.objects import Objects
from deepsimbad.store.shared_sessions import SharedSessionStore
from tests.contract.conftest import N_LANDMARKS, Client, path_of, problem, service, small_settings, until

pytest.importorskip("obstore", reason="the extra `objects` is not installed")


@contextmanager
def node(data_dir, url, is_own=lambda _: False, **settings):
    shared = Substitutes(sessions=partial(SharedSessionStore.open_shared, Objects.open(url), is_own=is_own))
    app = create_app(small_settings(data_dir, **settings), InThisProcess(data_dir), shared)
    with Client(app, raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mapped") / "data"
    with service(folder) as client:
        client.make_ready_domain("ready")
    return folder


@pytest.fixture
def nodes(mapped, tmp_path):
    """Makes a node of a given name, each with its own copy of the map."""
    with ExitStack() as running:

        def make(name, **settings):
            shutil.copytree(mapped, tmp_path / name, dirs_exist_ok=True)
            return running.enter_context(node(tmp_path / name, f"file://{tmp_path}/shared", **settings))

        yield make


def ranks(seed):
    return {"ranked_landmarks": np.random.default_rng(seed).permutation(N_LANDMARKS).tolist()}


def observe(client, path, seed, **headers):
    answer = client.post(f"{path}/observations?action_m=2", json=ranks(seed), headers=headers)
    assert answer.status_code == 200, answer.text
    return answer.json()


def told(answer):
    """What does not depend on when it was asked, and of whom."""
    return {name: answer[name] for name in ("n_observations", "belief", "next_best_view", "map_version")}


def test_a_session_goes_on_anywhere_with_the_answers_of_one_service(nodes, mapped, tmp_path):
    shutil.copytree(mapped, tmp_path / "plain")
    with service(tmp_path / "plain") as plain:
        alone = plain.session(seed=3)
        expected = [told(observe(plain, alone, seed)) for seed in range(8)]
    one, other = nodes("one"), nodes("other")
    path = one.session(seed=3)
    for seed, wanted in enumerate(expected):
        here, there = (one, other) if seed % 3 else (other, one)
        assert told(observe(here, path, seed)) == wanted
        assert told(there.get(path).json()) == wanted
    assert told(nodes("third").get(path).json()) == expected[-1]


def test_what_was_counted_elsewhere_counts_once(nodes):
    one, other = nodes("one"), nodes("other")
    begun = one.post("/v1/domains/ready/sessions", json={}, headers={"Idempotency-Key": "a"}).json()
    again = other.post("/v1/domains/ready/sessions", json={}, headers={"Idempotency-Key": "a"})
    assert (again.status_code, again.json()["session_id"]) == (201, begun["session_id"])
    path = path_of(begun)
    first = observe(one, path, 1, **{"Idempotency-Key": "b"})
    assert told(observe(other, path, 1, **{"Idempotency-Key": "b"})) == told(first)
    assert other.get(path).json()["n_observations"] == 1


def test_what_another_node_counts_in_the_same_moment_counts_once(nodes, monkeypatch):
    one, other = nodes("one"), nodes("other")
    path, objects = one.session(), one.services.session_store._objects
    create, quicker = objects.create, []

    def create_too_late(name, content):
        if not quicker:
            quicker.append(observe(other, path, 1, **{"Idempotency-Key": word}))
        return create(name, content)

    word = "same"
    monkeypatch.setattr(objects, "create", create_too_late)
    assert told(observe(one, path, 1, **{"Idempotency-Key": "same"})) == told(quicker[0])
    quicker.clear()
    word = "another"
    late = one.post(f"{path}/observations?action_m=2", json=ranks(1), headers={"Idempotency-Key": "late"})
    problem(late, 503, "session_moved")
    assert other.get(path).json()["n_observations"] == 2


def test_the_end_is_the_end_everywhere(nodes):
    one, other = nodes("one"), nodes("other", session_ttl_s=30)
    path, brief = one.session(), other.session()
    observe(other, path, 1)
    assert one.delete(path).status_code == 204
    problem(other.get(path), 410, "ended_session")
    problem(other.delete(path), 410, "ended_session")
    problem(nodes("third").post(f"{path}/observations", json=ranks(1)), 410, "ended_session")
    observe(one, brief, 1)  # lives as long as one's sessions do from now on, whatever the other believed
    other.services.sessions._clock = lambda: time.time() + 60
    assert told(other.get(brief).json()) == told(one.get(brief).json())
    one.services.sessions._clock = lambda: time.time() + 4000
    problem(one.get(brief), 410, "ended_session")
    problem(other.get(brief), 410, "ended_session")
    problem(one.get(f"/v1/sessions/{'0' * 32}"), 404, "unknown_session")


def test_of_two_at_once_each_counts_or_is_told(nodes):
    one, other = nodes("one"), nodes("other")
    path = one.session()
    with ThreadPoolExecutor(2) as robots:
        for seed in range(10):
            both = [
                robots.submit(client.post, f"{path}/observations?action_m=2", json=ranks(seed))
                for client in (one, other)
            ]
            for answer in both:
                if answer.result().status_code != 200:
                    document = problem(answer.result(), 503, "session_moved")
                    assert answer.result().headers["retry-after"] == "1", document
    n_counted = one.get(path).json()["n_observations"]
    assert 10 <= n_counted <= 20
    assert told(one.get(path).json()) == told(other.get(path).json()) == told(nodes("third").get(path).json())


def test_who_lives_is_known_everywhere(nodes):
    one, other = nodes("one", max_sessions=2), nodes("other", max_sessions=2)
    mine, yours = one.session(), other.session()
    for client in (one, other):
        problem(client.post("/v1/domains/ready/sessions", json={}), 429, "too_many_sessions")
        assert client.services.session_store.pins() == {("ready", 1)}
    assert other.delete(mine).status_code == 204
    third = one.session()
    for path in (yours, third):
        assert one.delete(path).status_code == 204
    assert other.services.session_store.pins() == set()
    assert other.services.session_store.holders() == []


def test_a_beginning_asks_who_began_since_and_at_the_limit_who_lives(nodes, monkeypatch):
    monkeypatch.setattr(shared_sessions, "_LISTING_AGE_S", 1e9)
    one, other = nodes("one", max_sessions=3), nodes("other", max_sessions=3)
    store, asked_after = one.services.session_store, []
    list_names = store._objects.names

    def names(prefix, after=None):
        asked_after.append(after)
        return list_names(prefix, after)

    monkeypatch.setattr(store._objects, "names", names)
    first, _, _ = one.session(), other.session(), one.session()
    assert len(store.holders(may_have_ended=True)) == 3
    assert None not in asked_after, "all were listed at the start"
    problem(one.post("/v1/domains/ready/sessions", json={}), 429, "too_many_sessions")
    assert asked_after.count(None) == 1
    other.delete(first)
    one.session()
    assert asked_after.count(None) == 2, "three lived when all were listed"
    monkeypatch.setattr(shared_sessions, "_LISTING_AGE_S", -1)
    assert len(store.holders(may_have_ended=True)) == 3
    assert asked_after[-1] is None


def test_a_node_that_is_back_looks_after_its_sessions(nodes):
    one = nodes("one", session_ttl_s=30)
    path, extended = one.session(), one.session()
    back = nodes("back", is_own=lambda _: True)
    assert back.services.sessions.n_living == 2
    observe(nodes("far", session_ttl_s=90), extended, 1)
    back.services.sessions._clock = lambda: time.time() + 60
    back.portal.call(back.services.sessions.sweep)
    problem(one.get(path), 410, "ended_session")
    assert one.get(extended).json()["n_observations"] == 1
    assert back.services.sessions.n_living == 1
    assert len(one.services.session_store.marks()) == 1


def test_who_takes_a_session_over_follows_it_from_its_newest_snapshot(nodes, tmp_path):
    one = nodes("one", snapshot_every=8)
    path = one.session(seed=3)
    for seed in range(20):
        answer = observe(one, path, seed)
    session_id = path.rpartition("/")[2]
    until((tmp_path / "shared/snapshots" / session_id).exists)
    other = nodes("other")
    assert told(other.get(path).json()) == told(answer)
    store = other.services.session_store
    snapshot, rows = store.history(store.find(session_id).number, 20)
    assert (snapshot.sequence, len(rows)) in {(8, 12), (16, 4)}  # nobody waits for the second to be written
    other.delete(path)
    assert not (tmp_path / "shared/snapshots" / session_id).exists()


def test_truths_are_known_everywhere(nodes):
    one, other = nodes("one"), nodes("other")
    path = one.session()
    for seed in range(3):
        observe(one, path, seed)
    assert one.post(f"{path}/truths", json={"true_positions_m": [0.0, 2.0, None]}).json()["n_scored"] == 2
    assert other.post(f"{path}/truths", json={"true_positions_m": [None, None, 4.0]}).json()["n_scored"] == 1
    for client in (one, other):
        assert client.post(f"{path}/truths", json={"true_positions_m": [None, 2.5, None]}).status_code == 200
    store = other.services.session_store
    assert store.true_positions(store.find(path.rpartition("/")[2]).number).tolist() == [0.0, 2.5, 4.0]
    counts = [client.get("/metrics").text for client in (one, other)]
    assert ['live_anr_percent_count{domain="ready"} 2.0' in text for text in counts] == [True, False]
    assert 'live_anr_percent_count{domain="ready"} 1.0' in counts[1]
