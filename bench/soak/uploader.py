"""Someone who uploads one traverse after the other, in batches and frame by frame, and deletes some."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.link import NPZ, Link, RefusedError, packed
from bench.soak.actor import BASE, DIM, DOMAIN, Actor, expect
from deepsimbad.store.traverses import Traverse

BATCH, FRAMES, KEPT = 10, 120, 3


def encoding(traverse: int, index: int) -> NDArray[np.float32]:
    """[d] of one frame."""
    return np.random.default_rng([2, traverse, index]).normal(size=DIM).astype(np.float32)


class Uploader(Actor):
    """Keeps the last few traverses; what it remembers of each is the set of frames that were acknowledged."""

    rests_s = 0.02

    def __init__(self) -> None:
        self._number = 0
        self._is_made = False
        self._n_sent = 0
        self._in_flight: set[int] = set()
        self._acknowledged: dict[int, set[int]] = {}
        self._deleting: int | None = None
        self._deleted: list[int] = []

    def act(self, link: Link) -> None:
        """Make a traverse, add frames to it, or delete the oldest."""
        if self._deleting is not None or len(self._acknowledged) > KEPT:
            self.doing = "deleting a traverse"
            self._deleting = self._deleting if self._deleting is not None else min(self._acknowledged)
            _is_there(link, "DELETE", self._deleting)  # or was deleted before the service died
            self._acknowledged.pop(self._deleting, None)
            self._deleted.append(self._deleting)
            self._deleting = None
        elif not self._is_made:
            self.doing = "making a traverse"
            link.ask("POST", f"{BASE}/traverses", {"name": name_of(self._number)})
            self._is_made, self._n_sent, self._acknowledged[self._number] = True, 0, set()
        elif self._n_sent >= FRAMES:
            self._number, self._is_made = self._number + 1, False
            return
        else:
            self._add(link)
        self.n_acknowledged += 1

    def _add(self, link: Link) -> None:
        self.doing = "uploading frames"
        path = f"{BASE}/traverses/{name_of(self._number)}/frames"
        is_batch = self._n_sent % (2 * BATCH) == 0
        index = np.arange(self._n_sent, self._n_sent + (BATCH if is_batch else 1))
        self._in_flight = set(index.tolist())
        encodings = np.stack([encoding(self._number, frame) for frame in index])
        if is_batch:
            link.ask("POST", path, packed(encodings=encodings, index=index, position_m=1.0 * index), NPZ)
        else:
            link.ask("PUT", f"{path}/{index[0]}?position_m={index[0]}", {"encoding": encodings[0].tolist()})
        self._acknowledged[self._number] |= self._in_flight
        self._in_flight = set()
        self._n_sent = int(index[-1]) + 1

    def check(self, link: Link) -> None:
        """No acknowledged frame is missing, no half batch is there, no deleted traverse is back."""
        for number, acknowledged in self._acknowledged.items():
            if number == self._deleting:
                continue
            answer = link.ask("GET", f"{BASE}/traverses/{name_of(number)}")
            in_flight = self._in_flight if number == self._number else set()
            expect(
                answer["n_frames"] in {len(acknowledged), len(acknowledged | in_flight)},
                f"{name_of(number)}: {answer} of {len(acknowledged)}",
            )
            gaps = {index for first, last in answer["missing"] for index in range(first, last + 1)}
            expect(not gaps & acknowledged, f"{name_of(number)} misses frames {sorted(gaps & acknowledged)}")
        for number in self._deleted[-3:]:
            expect(not _is_there(link, "GET", number), f"{name_of(number)} was deleted and is back")

    def check_bits(self, data_dir: Path) -> None:
        """Every acknowledged frame holds the very numbers that were sent."""
        for number, acknowledged in self._acknowledged.items():
            if number == self._deleting:
                continue
            with Traverse.open(data_dir, DOMAIN, name_of(number)) as traverse:
                frames = traverse.read()
            encodings = dict(zip(frames.index.tolist(), frames.encodings, strict=True))
            for index in acknowledged:
                expect(np.array_equal(encodings[index], encoding(number, index)), f"{name_of(number)} frame {index}")


def _is_there(link: Link, method: str, number: int) -> bool:
    try:
        link.ask(method, f"{BASE}/traverses/{name_of(number)}")
    except RefusedError as error:
        if error.status != 404:
            raise
        return False
    return True


def name_of(number: int) -> str:
    """Name of a traverse."""
    return f"drive-{number}"
