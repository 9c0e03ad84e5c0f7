"""Two that administer: each has its domains' drives and jobs, what is of all domains is whole, one dies alone."""

import asyncio
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ray", reason="the extra `ray` is not installed", exc_type=ImportError)

from deepsimbad.engine.session import domain_digits
from deepsimbad.errors import UnavailableError
from deepsimbad.fleet.placement import owners
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.layout import traverse_path
from deepsimbad.store.records import KeyScope
from tests.contract.conftest import (
    N_LANDMARKS,
    RANKS,
    TAKES_ENCODINGS,
    Caller,
    problem,
    ready_encodings,
    small_settings,
    wait_until,
)
from tests.fleet.running import running

with warnings.catch_warnings(action="ignore"):  # which are Ray's, of what it uses
    from deepsimbad.fleet import backend
    from deepsimbad.fleet.backend import Backend, Gone
    from deepsimbad.fleet.owners import Administrators
    from deepsimbad.fleet.replica import AllJobs


def of_fleet(test):
    """A test of running fleets; Ray leaves sockets and files to the collector."""
    quiet = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
    return pytest.mark.slow(quiet(test))


def administered_by(number, of=2):
    """Names of domains that one makes where there are so many."""
    names = (f"route-{name}" for name in range(1000))
    return (name for name in names if owners(domain_digits(name), of)[0] == number)


# Who is asked


@dataclass(eq=False)
class Administrator(Backend):
    """A stand-in for an administrator, which knows who made which domain, and its own jobs."""

    made_by: dict[str, int] | None = None  # None: it is away
    jobs: tuple[str, ...] = ()

    async def ask(self, method, *arguments):
        if self.made_by is None:
            raise Gone
        return self.made_by.get(*arguments) if method == "administrator_of" else arguments[0] in self.jobs


def candidates(administrators, path, query=b""):
    """The places of those who may answer."""
    backends = asyncio.run(administrators.of(path, query))
    return [administrators.backends.index(backend) for backend in backends]


def of_two(made_by):
    return Administrators(
        [Administrator(None, made_by=made_by, jobs=("a",)), Administrator(None, made_by=made_by, jobs=("b",))]
    )


@pytest.mark.parametrize("path", ["/v1/admin/domains/{}", "/v1/domains/{}/coverage", "/v1/admin/domains/{}/traverses"])
def test_what_is_of_a_domain_is_its_administrators(path):
    first, second = next(administered_by(0)), next(administered_by(1))
    assert [candidates(of_two({}), path.format(name)) for name in (first, second)] == [[0], [1]], "who is to make it"
    administrators = of_two({first: 1, second: 0})  # while there were others
    assert [candidates(administrators, path.format(name)) for name in (first, second)] == [[1], [0]]
    assert candidates(administrators, "/v1/admin/jobs", f"limit=3&domain={first}".encode()) == [1]


def test_a_domain_whose_administrator_there_is_not_is_refused_by_name():
    with pytest.raises(UnavailableError, match="--administrators 3 or more") as refusal:
        candidates(of_two({"far": 2}), "/v1/admin/domains/far/remaps")
    assert refusal.value.hints["reason"] == "no_administrator"
    with pytest.raises(UnavailableError, match="--administrators 2 or more"):
        candidates(Administrators([Administrator(None, made_by={"far": 1})]), "/v1/domains/far")


def test_a_domain_made_anew_is_whose_it_is_now():
    administrators = of_two({"moved": 2})
    with pytest.raises(UnavailableError, match="--administrators 3 or more"):
        candidates(administrators, "/v1/domains/moved")
    for number in (1, 0):
        for backend in administrators.backends:
            backend.made_by["moved"] = number
        assert candidates(administrators, "/v1/domains/moved") == [number]


def test_a_job_is_whose_it_is_and_what_is_of_no_domain_is_anybodys():
    administrators = of_two({})
    assert [candidates(administrators, f"/v1/admin/jobs/{job}") for job in ("a", "b", "c")] == [[0], [1], [0]]
    assert candidates(administrators, "/v1/admin/jobs/b/events") == [1]
    for path in ("/v1/domains", "/v1/admin/jobs", "/v1/admin/sessions", "/console", "/healthz"):
        assert candidates(administrators, path) == [0, 1]


def test_while_one_is_away_the_other_tells_whose_domains_are():
    second = next(administered_by(1))
    administrators = of_two({})
    administrators.backends[0].made_by = None
    assert candidates(administrators, f"/v1/admin/domains/{second}") == [1]
    assert candidates(administrators, "/v1/admin/jobs/b") == [1]
    for job in ("a", "c"):
        with pytest.raises(UnavailableError, match="away"):
            candidates(administrators, f"/v1/admin/jobs/{job}")
    administrators.backends[1].made_by = None
    with pytest.raises(UnavailableError, match="away"):
        candidates(administrators, f"/v1/admin/domains/{second}")


def test_one_that_does_not_answer_soon_is_as_one_that_is_away(monkeypatch):
    monkeypatch.setattr(backend, "BRIEFLY_S", 0.05)
    administrators = of_two({})

    async def never(*_):
        await asyncio.sleep(3600.0)

    administrators.backends[0].ask = never
    second = next(administered_by(1))
    assert candidates(administrators, f"/v1/admin/domains/{second}") == [1]
    assert candidates(administrators, "/v1/admin/jobs/b") == [1]
    with pytest.raises(UnavailableError, match="away"):
        candidates(administrators, "/v1/admin/jobs/a")


class Queued:
    """The answer of one that administers, which never comes, or does."""

    def __init__(self, jobs=None):
        self.answer, self.jobs, self.is_cancelled = jobs, self, False

    def remote(self, last_key, limit):
        return self

    def result(self, timeout_s):
        if self.answer is None:
            raise TimeoutError
        return self.answer

    def cancel(self):
        self.is_cancelled = True


def test_jobs_of_one_that_is_away_are_not_waited_for_after_the_refusal(tmp_path):
    jobs = AllJobs()
    jobs.other_administrators = [Queued([]), Queued(), Queued()]
    with Catalog.open(tmp_path) as catalog:
        with pytest.raises(UnavailableError, match="one of those that administer is away") as refusal:
            jobs.newest(catalog, None, None, 5)
        assert refusal.value.hints["retry_after_s"] > 0
        assert all(answer.is_cancelled for answer in jobs.other_administrators[1:])
        jobs.other_administrators = [Queued([])]
        assert jobs.newest(catalog, None, None, 5).records == ()
        assert not jobs.other_administrators[0].is_cancelled


# A fleet


class WaitsForTheOther:
    """Does a job once one of another data directory is under way too: neither ends where they take turns."""

    def __init__(self, data_dir):
        self.run = InThisProcess(data_dir)
        self.meeting = data_dir.parent.parent if data_dir.parent.name == "administrators" else data_dir
        self.mark = self.meeting / f"working-{data_dir.name}"

    def __call__(self, job, on_progress, is_cancelled):
        if job.config.get("seed") == 1:
            self.mark.touch()
            wait_until(lambda: len(list(self.meeting.glob("working-*"))) == 2)
        return self.run(job, on_progress, is_cancelled)


def make_filled_domain(client, name):
    """A domain with a drive."""
    assert client.put(f"/v1/admin/domains/{name}", json=TAKES_ENCODINGS).status_code == 201
    client.upload(name, "drive", ready_encodings(), 2.0 * np.arange(len(ready_encodings())))


CONFIG = {"training_traverse": "drive", "landmark_traverse": "drive", "n_landmarks": N_LANDMARKS, "list_length": 4}


def jobs_listed(client, query=""):
    """Pages of two, one behind the other."""
    jobs, cursor = [], ""
    while cursor is not None:
        answer = client.get(f"/v1/admin/jobs?limit=2{query}{cursor}").json()
        jobs += answer["jobs"]
        cursor = answer["next"] and f"&after={answer['next']}"
    return jobs


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory):
    return tmp_path_factory.mktemp("administrators") / "data"


@pytest.fixture(scope="module")
def fleet(data_dir):
    with running(small_settings(data_dir), make_run_job=WaitsForTheOther, n_administrators=2) as fleet:
        yield fleet


@pytest.fixture(scope="module")
def client(fleet):
    with Caller(base_url=fleet.url, timeout=120) as client:
        yield client


@pytest.fixture(scope="module")
def names():
    return next(administered_by(0)), next(administered_by(1))


@of_fleet
def test_two_domains_are_filled_and_mapped_at_once_and_listed_together(client, data_dir, names):
    for name in names:
        make_filled_domain(client, name)
    folders = data_dir, data_dir / "administrators" / "1"
    for name, folder, other_folder in zip(names, folders, folders[::-1], strict=True):
        assert traverse_path(folder, name, "drive").exists()
        assert not traverse_path(other_folder, name, "drive").exists()
    answers = [client.post(f"/v1/admin/domains/{name}/remaps", json={**CONFIG, "seed": 1}) for name in names]
    jobs = [client.wait_for(answer.json()["job_id"]) for answer in answers]
    assert [job["state"] for job in jobs] == ["succeeded"] * 2, jobs
    assert [job["domain"] for job in jobs] == list(names)
    for name in names:
        assert client.post(f"/v1/domains/{name}/localizations", json=RANKS).json()["map_version"] == 1
        assert client.session(name)
    domains = client.get("/v1/domains").json()["domains"]
    assert [(domain["name"], domain["map_version"]) for domain in domains] == [(name, 1) for name in sorted(names)]
    assert len(client.get("/v1/admin/sessions").json()["sessions"]) == 2
    ready = client.get("/readyz")
    assert ready.json() == {"status": "ready", "damaged_maps": []}
    assert ready.headers["x-request-id"]
    assert 'deepsimbad_jobs{state="succeeded"} 2.0' in client.get("/metrics").text


@of_fleet
def test_jobs_are_one_list_in_the_order_of_their_making(client, names):
    first, second = names
    job_ids = [client.remap(name, **CONFIG)["job_id"] for name in (second, first, first, second)]
    jobs = jobs_listed(client)
    assert [job["job_id"] for job in jobs[:4]] == job_ids[::-1]
    assert len(jobs) == len({job["job_id"] for job in jobs}) == 6
    for name in names:
        domain_jobs = jobs_listed(client, f"&domain={name}")
        assert domain_jobs == [job for job in jobs if job["domain"] == name]
    assert client.get(f"/v1/admin/jobs/{job_ids[0]}/events").text.count("event: done") == 1
    assert client.delete(f"/v1/admin/jobs/{job_ids[0]}").status_code == 204
    problem(client.get("/v1/admin/jobs/none"), 404, "unknown_job")


@of_fleet
def test_while_one_is_away_the_other_administers_and_what_it_had_is_there_when_it_is_back(
    fleet, client, data_dir, names
):
    first, second = names
    maps = client.get(f"/v1/admin/domains/{second}/maps").json()
    dying = fleet.pids("admin-1")
    fleet.kill("admin-1")
    assert client.remap(first, **CONFIG)["state"] == "succeeded"
    assert client.get("/v1/domains").status_code == 200
    wait_until(lambda: fleet.pids("admin-1") not in ([], dying))
    wait_until(lambda: client.get(f"/v1/admin/domains/{second}/maps").status_code == 200)
    assert client.get(f"/v1/admin/domains/{second}/maps").json() == maps
    assert client.remap(second, **CONFIG)["state"] == "succeeded"
    assert len(jobs_listed(client)) == 8


@of_fleet
def test_a_key_counts_with_all_of_them_before_it_counts_with_the_first(client, data_dir, names):
    with Catalog.open(data_dir) as catalog:
        _, admin = catalog.create_key(KeyScope.ADMIN)
    wait_until(lambda: client.get(f"/v1/domains/{names[0]}").status_code == 401)
    for name in (*names, "none"):
        assert client.get(f"/v1/domains/{name}").status_code == 401
        answer = client.get(f"/v1/domains/{name}", headers={"X-API-Key": admin.text})
        assert answer.status_code == (404 if name == "none" else 200)


@of_fleet
def test_another_number_moves_no_domain(tmp_path: Path):
    settings = small_settings(tmp_path / "data", map_store=f"file://{tmp_path}/store")
    names = administered_by(1)
    earlier_name, later_name = next(names), next(names)
    with running(settings, make_run_job=InThisProcess) as fleet, Caller(base_url=fleet.url, timeout=120) as client:
        make_filled_domain(client, earlier_name)  # which would be the second's, had it been there
    with (
        running(settings, make_run_job=InThisProcess, n_administrators=2) as fleet,
        Caller(base_url=fleet.url, timeout=120) as client,
    ):
        make_filled_domain(client, later_name)
        for name in (earlier_name, later_name):
            assert client.remap(name, **CONFIG)["state"] == "succeeded"
    with running(settings, make_run_job=InThisProcess) as fleet, Caller(base_url=fleet.url, timeout=120) as client:
        refusal = problem(client.get(f"/v1/admin/domains/{later_name}/traverses"), 503, "unavailable")
        assert refusal["reason"] == "no_administrator"
        assert client.get(f"/v1/admin/domains/{earlier_name}/traverses/drive").status_code == 200
        assert client.post(f"/v1/domains/{later_name}/localizations", json=RANKS).status_code == 200, "robots go on"
