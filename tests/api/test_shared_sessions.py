"""Two services with the same maps share the journals of their sessions: each goes on with the sessions of the other."""

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
from tests.contract.conftest import N_LANDMARKS, Client, path_of, problem, service, small_settings, wait_until

pytest.importorskip("obstore", reason="the extra `objects` is not installed")


@contextmanager
def node(data_dir, url, is_own=lambda _: False, **settings):
    shared = Substitutes(sessions=partial(SharedSessionStore.open_shared, Objects.open(url), is_own=is_own))
    app = create_app(small_settings(data_dir, **settings), InThisProcess(data_dir), shared)
    with Client(app, raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def mapped_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mapped") / "data"
    with service(folder) as client:
        client.make_ready_domain("ready")
    return folder


@pytest.fixture
def nodes(mapped_dir, tmp_path):
    """A function that starts a node by its name, with its own copy of the map."""
    with ExitStack() as running:

        def make(name, **settings):
            shutil.copytree(mapped_dir, tmp_path / name, dirs_exist_ok=True)
            return running.enter_context(node(tmp_path / name, f"file://{tmp_path}/shared", **settings))

        yield make


def ranks(seed):
    return {"ranked_landmarks": np.random.default_rng(seed).permutation(N_LANDMARKS).tolist()}


def observe(client, path, seed, **headers):
    answer = client.post(f"{path}/observations?action_m=2", json=ranks(seed), headers=headers)
    assert answer.status_code == 200, answer.text
    return answer.json()


def lasting_answer(answer):
    """The members of an answer that depend neither on the time nor on the node."""
    return {name: answer[name] for name in ("n_observations", "belief", "next_best_view", "map_version")}


def test_a_session_goes_on_anywhere_with_the_answers_of_one_service(nodes, mapped_dir, tmp_path):
    shutil.copytree(mapped_dir, tmp_path / "plain")
    with service(tmp_path / "plain") as plain:
        plain_path = plain.session(seed=3)
        expected = [lasting_answer(observe(plain, plain_path, seed)) for seed in range(8)]
    node_a, node_b = nodes("a"), nodes("b")
    path = node_a.session(seed=3)
    for seed, answer in enumerate(expected):
        asked_node, other_node = (node_a, node_b) if seed % 3 else (node_b, node_a)
        assert lasting_answer(observe(asked_node, path, seed)) == answer
        assert lasting_answer(other_node.get(path).json()) == answer
    assert lasting_answer(nodes("c").get(path).json()) == expected[-1]


def test_what_was_counted_elsewhere_counts_once(nodes):
    node_a, node_b = nodes("a"), nodes("b")
    session = node_a.post("/v1/domains/ready/sessions", json={}, headers={"Idempotency-Key": "a"}).json()
    repetition = node_b.post("/v1/domains/ready/sessions", json={}, headers={"Idempotency-Key": "a"})
    assert (repetition.status_code, repetition.json()["session_id"]) == (201, session["session_id"])
    path = path_of(session)
    first = observe(node_a, path, 1, **{"Idempotency-Key": "b"})
    assert lasting_answer(observe(node_b, path, 1, **{"Idempotency-Key": "b"})) == lasting_answer(first)
    assert node_b.get(path).json()["n_observations"] == 1


def test_what_another_node_counts_in_the_same_moment_counts_once(nodes, monkeypatch):
    node_a, node_b = nodes("a"), nodes("b")
    path, objects = node_a.session(), node_a.services.session_store._objects
    create, first_answers = objects.create, []

    def create_too_late(name, content):
        if not first_answers:
            first_answers.append(observe(node_b, path, 1, **{"Idempotency-Key": word}))
        return create(name, content)

    word = "same"
    monkeypatch.setattr(objects, "create", create_too_late)
    assert lasting_answer(observe(node_a, path, 1, **{"Idempotency-Key": "same"})) == lasting_answer(first_answers[0])
    first_answers.clear()
    word = "another"
    late = node_a.post(f"{path}/observations?action_m=2", json=ranks(1), headers={"Idempotency-Key": "late"})
    problem(late, 503, "session_moved")
    assert node_b.get(path).json()["n_observations"] == 2


def test_the_end_is_the_end_everywhere(nodes):
    node_a, node_b = nodes("a"), nodes("b", session_ttl_s=30)
    path, brief = node_a.session(), node_b.session()
    observe(node_b, path, 1)
    assert node_a.delete(path).status_code == 204
    problem(node_b.get(path), 410, "ended_session")
    problem(node_b.delete(path), 410, "ended_session")
    problem(nodes("c").post(f"{path}/observations", json=ranks(1)), 410, "ended_session")
    observe(node_a, brief, 1)  # from now on it lives as long as the sessions of node a, though node b began it
    node_b.services.sessions._clock = lambda: time.time() + 60
    assert lasting_answer(node_b.get(brief).json()) == lasting_answer(node_a.get(brief).json())
    node_a.services.sessions._clock = lambda: time.time() + 4000
    problem(node_a.get(brief), 410, "ended_session")
    problem(node_b.get(brief), 410, "ended_session")
    problem(node_a.get(f"/v1/sessions/{'0' * 32}"), 404, "unknown_session")


def test_of_two_at_once_each_counts_or_is_told(nodes):
    node_a, node_b = nodes("a"), nodes("b")
    path = node_a.session()
    with ThreadPoolExecutor(2) as robots:
        for seed in range(10):
            answers = [
                robots.submit(client.post, f"{path}/observations?action_m=2", json=ranks(seed))
                for client in (node_a, node_b)
            ]
            for answer in answers:
                if answer.result().status_code != 200:
                    document = problem(answer.result(), 503, "session_moved")
                    assert answer.result().headers["retry-after"] == "1", document
    n_counted = node_a.get(path).json()["n_observations"]
    assert 10 <= n_counted <= 20
    assert (
        lasting_answer(node_a.get(path).json())
        == lasting_answer(node_b.get(path).json())
        == lasting_answer(nodes("c").get(path).json())
    )


def test_who_lives_is_known_everywhere(nodes):
    node_a, node_b = nodes("a", max_sessions=2), nodes("b", max_sessions=2)
    path_a, path_b = node_a.session(), node_b.session()
    for client in (node_a, node_b):
        problem(client.post("/v1/domains/ready/sessions", json={}), 429, "too_many_sessions")
        assert client.services.session_store.pins() == {("ready", 1)}
    assert node_b.delete(path_a).status_code == 204
    path_c = node_a.session()
    for path in (path_b, path_c):
        assert node_a.delete(path).status_code == 204
    assert node_b.services.session_store.pins() == set()
    assert node_b.services.session_store.holders() == []


def test_a_beginning_asks_who_began_since_and_at_the_limit_who_lives(nodes, monkeypatch):
    monkeypatch.setattr(shared_sessions, "_LISTING_AGE_S", 1e9)
    node_a, node_b = nodes("a", max_sessions=3), nodes("b", max_sessions=3)
    store, after_names = node_a.services.session_store, []
    list_names = store._objects.names

    def names(prefix, after_name=None):
        after_names.append(after_name)
        return list_names(prefix, after_name)

    monkeypatch.setattr(store._objects, "names", names)
    first, _, _ = node_a.session(), node_b.session(), node_a.session()
    assert len(store.holders(may_have_ended=True)) == 3
    assert None not in after_names, "all were listed at the start"
    problem(node_a.post("/v1/domains/ready/sessions", json={}), 429, "too_many_sessions")
    assert after_names.count(None) == 1
    node_b.delete(first)
    node_a.session()
    assert after_names.count(None) == 2, "three lived when all were listed"
    monkeypatch.setattr(shared_sessions, "_LISTING_AGE_S", -1)
    assert len(store.holders(may_have_ended=True)) == 3
    assert after_names[-1] is None


def test_a_node_that_is_back_looks_after_its_sessions(nodes):
    node_a = nodes("a", session_ttl_s=30)
    path, extended = node_a.session(), node_a.session()
    node_back = nodes("back", is_own=lambda _: True)
    assert node_back.services.sessions.n_living == 2
    observe(nodes("far", session_ttl_s=90), extended, 1)
    node_back.services.sessions._clock = lambda: time.time() + 60
    node_back.portal.call(node_back.services.sessions.sweep)
    problem(node_a.get(path), 410, "ended_session")
    assert node_a.get(extended).json()["n_observations"] == 1
    assert node_back.services.sessions.n_living == 1
    assert len(node_a.services.session_store.marks()) == 1


def test_who_takes_a_session_over_follows_it_from_its_newest_snapshot(nodes, tmp_path):
    node_a = nodes("a", snapshot_every=8)
    path = node_a.session(seed=3)
    for seed in range(20):
        answer = observe(node_a, path, seed)
    session_id = path.rpartition("/")[2]
    wait_until((tmp_path / "shared/snapshots" / session_id).exists)
    node_b = nodes("b")
    assert lasting_answer(node_b.get(path).json()) == lasting_answer(answer)
    store = node_b.services.session_store
    snapshot, rows = store.history(store.find(session_id).number, 20)
    assert (snapshot.sequence, len(rows)) in {(8, 12), (16, 4)}  # nobody waits for the second to be written
    node_b.delete(path)
    assert not (tmp_path / "shared/snapshots" / session_id).exists()


def test_truths_are_known_everywhere(nodes):
    node_a, node_b = nodes("a"), nodes("b")
    path = node_a.session()
    for seed in range(3):
        observe(node_a, path, seed)
    assert node_a.post(f"{path}/truths", json={"true_positions_m": [0.0, 2.0, None]}).json()["n_scored"] == 2
    assert node_b.post(f"{path}/truths", json={"true_positions_m": [None, None, 4.0]}).json()["n_scored"] == 1
    for client in (node_a, node_b):
        assert client.post(f"{path}/truths", json={"true_positions_m": [None, 2.5, None]}).status_code == 200
    store = node_b.services.session_store
    assert store.true_positions(store.find(path.rpartition("/")[2]).number).tolist() == [0.0, 2.5, 4.0]
    counts = [client.get("/metrics").text for client in (node_a, node_b)]
    assert ['live_anr_percent_count{domain="ready"} 2.0' in text for text in counts] == [True, False]
    assert 'live_anr_percent_count{domain="ready"} 1.0' in counts[1]
