"""Someone who remaps the domain again and again, activates, and rolls back."""

import time
from typing import Any

import numpy as np

from bench.link import Link
from bench.soak.actor import BASE, DOMAIN, Actor, expect, remap_config

SWITCHES = 6  # between two remaps, on average


class Mapper(Actor):
    """Knows which versions may serve: those in answers, and those that a request without an answer named.

    Args:
        seed: Of its choices.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._job: dict[str, Any] | None = None
        self._asking = False
        self._may_serve: set[int] = {1}
        self._ended_jobs: dict[str, dict[str, Any]] = {}
        self._sealed: dict[int, str] = {}
        self.n_interrupted = 0

    @property
    def n_remaps(self) -> int:
        """Remaps that succeeded."""
        return sum(job["state"] == "succeeded" for job in self._ended_jobs.values())

    def act(self, link: Link) -> None:
        """Ask for a remap, follow it, or switch versions."""
        if self._job is not None:
            job = link.ask("GET", f"/v1/admin/jobs/{self._job['job_id']}")
            self.doing = f"remap: {job['stage'] or job['state']}"
            if job["state"] in {"queued", "running"}:
                time.sleep(0.03)
            else:
                self._end(link, job)
        elif not self._asking and len(self._sealed) > 1 and self._rng.random() < SWITCHES / (SWITCHES + 1):
            self._switch(link)
        else:
            self.doing, self._asking = "asking for a remap", True
            landmarks = "summer" if self._rng.random() < 0.5 else None
            config = remap_config("spring", landmarks, activate=bool(self._rng.random() < 0.7))
            self._job = link.ask("POST", f"{BASE}/remaps", config)
            self._asking = False
            self.n_acknowledged += 1

    def finish(self, link: Link) -> None:
        """Wait, once nobody kills any more, for the remap under way, or for one asked for now if none has ended."""
        while self._job is not None or not self._ended_jobs:
            self.act(link)

    def _end(self, link: Link, job: dict[str, Any]) -> None:
        self._job, self._ended_jobs[job["job_id"]] = None, job
        if job["state"] == "succeeded":
            version = job["result"]["map_version"]
            if job["result"]["active"]:
                self._may_serve = {version}
            self._learn_versions(link)
            expect(version in self._sealed, f"job {job['job_id']} made map {version}, which is not there")
        else:
            # Three deaths in a row while one job ran: it says so, and the domain goes on with what it had.
            expect((job["error"] or {}).get("code") == "job_interrupted", f"a remap failed: {job}")
            self.n_interrupted += 1

    def _switch(self, link: Link) -> None:
        self.doing = "activating"
        version_serving = link.ask("GET", f"/v1/domains/{DOMAIN}")["map_version"]
        versions = [record["version"] for record in self._learn_versions(link) if record["removed_at"] is None]
        version = int(
            self._rng.choice([version for version in versions if version != version_serving] or [version_serving])
        )
        self.doing = "activating" if version > version_serving else "rolling back"
        self._may_serve = {version_serving, version}
        link.ask("PUT", f"{BASE}/active-map", {"version": version, "expected": version_serving})
        self._may_serve = {version}
        self.n_acknowledged += 1

    def _learn_versions(self, link: Link) -> list[dict[str, Any]]:
        records: list[dict[str, Any]] = link.ask("GET", f"{BASE}/maps?limit=1000")["maps"]
        sealed = [record for record in records if record["state"] != "building"]
        self._sealed = {record["version"]: record["sha256"] for record in sealed}
        return sealed

    def check(self, link: Link) -> None:
        """A version that may serve does, no sealed version and no job is lost, and the job under way goes on."""
        domain = link.ask("GET", f"/v1/domains/{DOMAIN}")
        expect(domain["map_problem"] is None, f"the map does not answer: {domain}")
        version = domain["map_version"]
        records = {record["version"]: record for record in link.ask("GET", f"{BASE}/maps?limit=1000")["maps"]}
        newer = {version_ for version_ in records if version_ > max(self._sealed, default=0)}
        allowed = self._may_serve | (newer if self._job is not None or self._asking else set())
        expect(version in allowed, f"map {version} serves, of {sorted(allowed)}")
        expect(records[version]["state"] == "active", f"map {version} serves but is {records[version]['state']}")
        for sealed, digest in self._sealed.items():
            expect(records.get(sealed, {}).get("sha256") == digest, f"map {sealed} is lost or another")
        for job_id, ended_job in list(self._ended_jobs.items())[-5:]:
            expect(link.ask("GET", f"/v1/admin/jobs/{job_id}") == ended_job, f"job {job_id} has changed its end")
        if self._asking:  # the job may have been noted without an answer
            jobs = link.ask("GET", f"/v1/admin/jobs?domain={DOMAIN}&limit=1")["jobs"]
            if jobs and jobs[0]["job_id"] not in self._ended_jobs:
                self._job = jobs[0]
            self._asking = False
        if self._job is not None:
            job = link.ask("GET", f"/v1/admin/jobs/{self._job['job_id']}")
            expect(job["state"] != "cancelled", f"nobody cancelled {job}")
