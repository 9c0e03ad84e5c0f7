"""What an active episode is played on: a domain's map, a recording to drive along, and the truth to judge by."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from deepsimbad_client.episode_log import EpisodeStep
from deepsimbad_client.errors import ReplayError
from deepsimbad_client.http.client import Client, Session
from deepsimbad_client.http.models import Domain
from deepsimbad_client.judge import Judge
from deepsimbad_client.recordings.recording import Recording
from deepsimbad_client.replay import changed_map, fetch_route
from deepsimbad_client.walk import Seen, Walk, drive

DEFAULT_PLANNER = "default"
"""Asks the service for the planner that ships."""
_LONGEST_ACTION_M = 10.0


@dataclass(frozen=True)
class Stage:
    """Everything an episode needs but its session.

    Attributes:
        client: The client.
        domain: As the service described it.
        walk: The recording to drive along.
        judge: Knows the map's images and the truth.
    """

    client: Client
    domain: Domain
    walk: Walk
    judge: Judge

    @classmethod
    def of(cls, client: Client, recording: Recording, domain: str) -> Self:
        """Learn what is needed of a domain.

        Raises:
            ReplayError: It has no active map, or the recording cannot be driven along.
        """
        described = client.domain(domain)
        if described.map_version is None or described.n_map_images is None:
            raise ReplayError(f"domain {domain} has no active map to replay against: remap it first")
        walk = Walk(recording, described.input_size)
        route = fetch_route(client, recording, described)
        return cls(client, described, walk, Judge(recording, route))

    def start(self, steps: int, seed: int, episode: int) -> tuple[int, int]:
        """Draw an episode's first row and its session's seed; see `Walk.start`."""
        return self.walk.start(steps, max(self.domain.actions_m, default=_LONGEST_ACTION_M), seed, episode)

    def session(self, planner: str, seed: int) -> Session:
        """Begin a session for an episode.

        Raises:
            ReplayError: The active map is another than the one that was described.
            ApiError: The service refused, for example an unknown planner.
        """
        wanted = None if planner == DEFAULT_PLANNER else planner
        session = self.client.session(self.domain.name, seed=seed, planner=wanted)
        if session.map_version != self.domain.map_version:
            session.delete()
            raise changed_map(self.domain.name)
        return session

    def play(
        self, session: Session, row: int, steps: int, clock: Callable[[], float] = time.perf_counter
    ) -> Iterator[tuple[Seen, EpisodeStep]]:
        """Drive one episode and judge every view; see `drive`."""
        route = self.judge.route
        middle_m = float(np.median(route.path.position_m))
        travelled_m = 0.0
        for seen in drive(
            session, self.walk, row, steps, clock, route_middle_m=middle_m, route_length_m=route.length_m
        ):
            travelled_m += seen.action_m
            yield seen, self.judge.step(seen, session.belief_masses(), travelled_m)
