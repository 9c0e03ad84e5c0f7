"""The stages of a job, one after the other: what was finished before an interruption is not done again."""

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from deepsimbad.errors import DeepSimbadError
from deepsimbad.jobs.progress import Progress
from deepsimbad.store.checkpoints import Checkpoint, Checkpoints

T = TypeVar("T")
_log = logging.getLogger(__name__)


class Stages:
    """Runs stages, times them and keeps what they make.

    Args:
        progress: Told of every stage.
        checkpoints: Where finished stages are kept; None: nowhere.

    Attributes:
        inputs: The digest of all that the job depends on; checkpoints are used and written once it is set.
        seconds: What every stage took, by its name; of one that was done before, what it took then.
    """

    def __init__(self, progress: Progress, checkpoints: Checkpoints | None) -> None:
        self._progress = progress
        self._checkpoints = checkpoints
        self.inputs: str | None = None
        self.seconds: dict[str, float] = {}

    def run(self, stage: str, make: Callable[[], T]) -> T:
        """Run a stage that is done anew whenever the job is.

        Args:
            stage: Its name, as the progress knows it.
            make: Does it.
        """
        self._progress.stage(stage)
        began = time.perf_counter()
        made = make()
        self.seconds[_key(stage)] = time.perf_counter() - began
        return made

    def run_once(
        self,
        stage: str,
        make: Callable[[], T],
        pack: Callable[[T], Checkpoint],
        unpack: Callable[[Checkpoint], T],
    ) -> T:
        """Run a stage, or take what it made of the same inputs before the job was interrupted.

        Args:
            stage: Its name.
            make: Does it.
            pack: What it made, to be kept.
            unpack: Back from what was kept.
        """
        if self._checkpoints is None or self.inputs is None:
            return self.run(stage, make)
        kept = self._checkpoints.load(stage, self.inputs)
        if kept is not None:
            self._progress.stage(stage)
            self._progress.skip()
            self.seconds[_key(stage)] = kept.document["seconds"]
            _log.info("stage was done before", extra={"stage": stage})
            return unpack(kept)
        made = self.run(stage, make)
        packed = pack(made)
        try:
            self._checkpoints.save(
                stage, self.inputs, packed.arrays, {**packed.document, "seconds": self.seconds[_key(stage)]}
            )
        except DeepSimbadError as error:  # the job needs no checkpoint as long as its process lives
            _log.warning("checkpoint not kept", extra={"stage": stage, "why": str(error)})
        return made


def _key(stage: str) -> str:
    return stage.replace(" ", "_")
