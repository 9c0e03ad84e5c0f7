"""Robots that observe as fast as they are answered."""

from pathlib import Path
from typing import Any

import numpy as np

from bench.link import BINARY, Link
from bench.soak.actor import DOMAIN, N_LANDMARKS, Actor, expect
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.engine.localizer import RankedLandmarks, describe
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.store.catalog import Catalog

ACTION_M = 1.5


class Robot(Actor):
    """One session for as long as it may live; every observation has a key, so that it can be sent again.

    Args:
        number: Of the robot; the seed of all its views.
        kind: Its filter.
        session_length: It ends its session after so many observations and begins another; None: never.
    """

    rests_s = 0.02

    def __init__(self, number: int, kind: FilterKind, session_length: int | None = None) -> None:
        self.number, self.kind = number, kind
        self._session_length = session_length
        self._session_id = ""
        self._n_told = 0
        self._belief: dict[str, Any] = {}

    def ranks(self, view: int) -> list[int]:
        """The ranked landmarks of its n-th view."""
        permutation: list[int] = np.random.default_rng([self.number, view]).permutation(N_LANDMARKS).tolist()
        return permutation

    def act(self, link: Link) -> None:
        """Begin, observe, or end."""
        if not self._session_id:
            self.doing = "beginning a session"
            body = {"seed": self.number, "belief": self.kind.value}
            self._session_id = link.ask("POST", f"/v1/domains/{DOMAIN}/sessions", body)["session_id"]
            self._n_told = 0
        elif self._n_told == self._session_length:
            self.doing = "ending a session"
            ending, self._session_id = self._session_id, ""  # whether it ended or not, it is not used again
            link.ask("DELETE", f"/v1/sessions/{ending}")
        else:
            self.doing = "observing"
            path = f"/v1/sessions/{self._session_id}/observations?action_m={ACTION_M}"
            view = {"ranked_landmarks": self.ranks(self._n_told)}
            answer = link.ask("POST", path, view, {"Idempotency-Key": f"view-{self._n_told}"})
            expect(answer["n_observations"] == self._n_told + 1, f"robot {self.number} was miscounted")
            self._n_told, self._belief = self._n_told + 1, answer["belief"]
        self.n_acknowledged += 1

    def check(self, link: Link) -> None:
        """The session has every observation that was answered, and the belief of the last answer."""
        if not self._session_id:
            return
        state = link.ask("GET", f"/v1/sessions/{self._session_id}")
        # One more may be on the disk than was told of: the kill came between the commit and the answer.
        n_more = state["n_observations"] - self._n_told
        expect(n_more in {0, 1}, f"robot {self.number}: {state['n_observations']} of {self._n_told} observations")
        if n_more == 0 and self._n_told:
            expect(state["belief"] == self._belief, f"robot {self.number} has another belief")

    def check_bits(self, link: Link, data_dir: Path) -> None:
        """The mass of every map image equals that of all views in one go, without a service, bit for bit."""
        if not self._session_id:
            return
        state = link.ask("GET", f"/v1/sessions/{self._session_id}")
        belief: bytes = link.ask("GET", f"/v1/sessions/{self._session_id}/belief", headers={"Accept": BINARY})
        with Catalog.open(data_dir) as catalog:
            snapshot = load_snapshot(catalog, DOMAIN, state["map_version"])
        localizer = ActiveLocalizer(snapshot, LocalizerConfig(filter=self.kind, seed=self.number))
        reference = localizer.start()
        for view in range(state["n_observations"]):
            query = describe(snapshot, FeatureL2("none"), RankedLandmarks(tuple(self.ranks(view))))
            reference = localizer.step(reference, query, ACTION_M).state
        expected = reference.belief.mass.astype(np.float32).tobytes()
        expect(belief.endswith(expected), f"robot {self.number}'s belief differs from that of an undisturbed drive")
