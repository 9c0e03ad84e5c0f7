"""Remapping a domain: from stored traverses to a sealed, active map version (design section 5).

A remap makes a map of its own, or appends a drive to a copy of the active one: then no frame that is in the map is
encoded or described again, and how landmarks are to be trusted, and how a robot off the route is known, stay as two
seasons taught them.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from deepsimbad.core.building import append_drive
from deepsimbad.core.drive import UNKNOWN_TIMESTAMP, Drive
from deepsimbad.core.map import Map
from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.errors import InvalidEncodingError, InvalidMapConfigError, LostActivationError, WeightsDifferError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build import build, choose_landmarks, measured
from deepsimbad.jobs.check import CheckFrames, check_map, traverses_in
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import DEFAULT_LIST_LENGTH, DEFAULT_N_LANDMARKS, RemapConfig
from deepsimbad.jobs.train import train_nnql
from deepsimbad.jobs.versions import activate_once, seal_version
from deepsimbad.store.catalog import ANY, Catalog
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import DomainRecord, MapRecord
from deepsimbad.store.traverses import Traverse


def remap(
    catalog: Catalog,
    domain: str,
    config: RemapConfig,
    evaluator: Evaluator,
    progress: Progress,
    n_threads: int = 1,
    job_id: str | None = None,
) -> dict[str, Any]:
    """Build, seal and, if asked, activate the next map version of a domain.

    Nothing that serves changes before the last step, and a failed or cancelled remap leaves nothing behind. The last
    word wins: what was activated or rolled back while the remap ran gives way to the new map. With a gate the new map
    takes over only from the map it was compared with; else, or where it lost, it stays sealed and
    `metrics.check.why` says so.

    Args:
        progress: Reports the stages of REMAP_STAGES; may cancel.
        job_id: The job that this is: one that was interrupted after it sealed its version makes no other. None: none.

    Returns:
        `{"map_version", "active", "metrics"}`, as the job's result.

    Raises:
        DeepSimbadError: Whatever is wrong with the traverses, the parameters or the storage, by name.
    """
    sealed = None if job_id is None else catalog.map_of_job(domain, job_id)
    if sealed is None:
        sealed = _Remap(catalog, domain, config, evaluator, progress, n_threads).sealed(job_id)
    progress.stage("activate")
    check = sealed.metrics["check"]
    active = config.activate and check["passed"] is not False
    if active:
        try:
            activate_once(catalog, domain, sealed, ANY if config.gate_margin is None else check["active_version"])
        except LostActivationError as error:
            active = False
            why = f"{error.message}; the new map was compared with another one, and stays sealed"
            check = {**check, "why": why}
    return {"map_version": sealed.version, "active": active, "metrics": {**sealed.metrics, "check": check}}


@dataclass(frozen=True)
class _Inputs:
    """What a remap reads before it begins."""

    domain: DomainRecord  # whose map is draft
    training: Drive  # the traverse that becomes the map
    candidates: Drive | None  # the traverse landmarks are selected from; None: those of `base` stay
    base: Map | None  # the active map whose landmarks stay; None where they are selected
    # The drive that a calibrated map learns from: the landmark traverse, else what the active map was made of; None
    # where there is none of the same encoder, or where frames are appended
    second: Drive | None
    check: Drive | None  # the drive that the new map is checked on; None: on frames of `training` that are held out


@dataclass(frozen=True)
class _Draft:
    """A map that is not yet sealed."""

    map: Map  # all of it; its version is not known yet
    config: Mapping[str, Any]  # as the catalog keeps it
    training: Mapping[str, Any] | None  # how its experience database was learnt; None where it has none
    # Whether it learnt from a second drive, and why not; None where there was none
    second_season: Mapping[str, Any] | None


@dataclass(frozen=True)
class _Remap:
    """One remap's surroundings, as the arguments of `remap`; the methods are its stages."""

    catalog: Catalog
    domain: str
    config: RemapConfig
    evaluator: Evaluator
    progress: Progress
    n_threads: int
    seconds: dict[str, float] = field(default_factory=dict)

    def sealed(self, job_id: str | None) -> MapRecord:
        """The next version, sealed; what is decided of it later must stand in its metrics."""
        with self._stage("read frames"):
            inputs = self._read()
        draft = self._appended(inputs, inputs.base) if inputs.base and self.config.append else self._mapped(inputs)
        with self._stage("check"):
            check = self._checked(inputs, draft)
        self.progress.stage("seal")
        metrics = {
            "n_map_images": draft.map.n_images,
            "seconds": self.seconds,
            "training": draft.training,
            "second_season": draft.second_season,
            "check": check,
        }
        return seal_version(self.catalog, self.domain, draft.map, draft.config, metrics, self.progress.update, job_id)

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Report a stage and time it."""
        self.progress.stage(name)
        began = time.perf_counter()
        yield
        self.seconds[name.replace(" ", "_")] = time.perf_counter() - began

    def _read(self) -> _Inputs:
        """Read what is needed, every traverse once.

        Raises:
            UnknownDomainError, UnknownTraverseError: There is none such.
            InvalidMapConfigError: A traverse is empty, or no landmarks could stay.
            InvalidRouteError: The training or the check traverse goes backwards.
            InvalidEncodingError: The traverses come from two encoders.
            WeightsDifferError: Their images were encoded by other weights.
        """
        config, record = self.config, self.catalog.domain(self.domain)
        read = cache(self._drive)
        training = read(config.training_traverse)
        training.route(record.closed)  # what is wrong with it is said now, not after the map is built
        candidates = base = check = None
        if config.landmark_traverse is None:
            base = self._active_map(record)
            joining = f"traverse {config.training_traverse}"
            WeightsDifferError.check("the active map", base.weights_sha256, joining, training.weights_sha256)
        else:
            candidates = read(config.landmark_traverse)
            self._check_encoder(config.landmark_traverse, candidates, training)
        if config.check_traverse is not None:
            check = read(config.check_traverse)
            self._check_encoder(config.check_traverse, check, training)
            check.route(record.closed)
        second = None if config.append else self._second_season(record, training, read)
        return _Inputs(record, training, candidates, base, second, check)

    def _drive(self, name: str) -> Drive:
        with Traverse.open(self.catalog.data_dir, self.domain, name) as traverse:
            drive = traverse.read()
        if drive.n_frames == 0:
            raise InvalidMapConfigError(f"traverse {name} has no frames yet; upload some first", traverse=name)
        return drive

    def _check_encoder(self, name: str, drive: Drive, training: Drive) -> None:
        training_name = self.config.training_traverse
        if drive.encoding_dim != training.encoding_dim:
            raise InvalidEncodingError(
                f"traverse {name} holds encodings of {drive.encoding_dim} numbers, traverse {training_name} of "
                f"{training.encoding_dim}; both must come from the same encoder"
            )
        WeightsDifferError.check(
            f"traverse {training_name}", training.weights_sha256, f"traverse {name}", drive.weights_sha256
        )

    def _second_season(self, record: DomainRecord, training: Drive, read: Callable[[str], Drive]) -> Drive | None:
        names = [self.config.landmark_traverse]
        if names[0] is None and record.active_version is not None:
            before = self.catalog.map(record.name, record.active_version).config
            names = [before["training_traverse"], before["landmark_traverse"]]
        stored = Traverse.list(self.catalog.data_dir, record.name)
        for name in names:
            if name is not None and name != self.config.training_traverse and name in stored:
                second = read(name)
                weights = {second.weights_sha256, training.weights_sha256} - {None}
                if second.encoding_dim == training.encoding_dim and len(weights) <= 1:
                    return second  # else another encoder made it anew
        return None

    def _active_map(self, record: DomainRecord) -> Map:
        wanted = self.config.n_landmarks
        if record.active_version is None:
            raise InvalidMapConfigError(
                f"domain {record.name} has no active map that could be appended to"
                if self.config.append
                else f"domain {record.name} has no active map whose landmarks could stay; give a landmark_traverse"
            )
        base = read_map(self.catalog.map_path(record.name, record.active_version))
        if wanted not in {None, base.n_landmarks}:
            raise InvalidMapConfigError(
                f"the active map has {base.n_landmarks} landmarks, not {wanted}; give a landmark_traverse to select "
                "anew",
                n_landmarks=base.n_landmarks,
            )
        return base

    def _mapped(self, inputs: _Inputs) -> _Draft:
        """The training traverse as a map of its own."""
        config, domain, training = self.config, inputs.domain, inputs.training
        with self._stage("select landmarks"):
            if inputs.base is not None:
                model = inputs.base.landmark_model
            else:
                candidates = (inputs.candidates or training).encodings
                n_landmarks = config.n_landmarks or min(DEFAULT_N_LANDMARKS, len(candidates))
                model = choose_landmarks(candidates, n_landmarks, self.evaluator, self.progress.update)
        with self._stage("describe"):
            built = build(
                training,
                inputs.second,
                config.same_route,
                self.evaluator,
                model,
                config.relevance,
                config.list_length,
                domain.actions_m,
                domain.closed,
                self.progress.update,
            )
        q_values = learning = None
        # The baseline that compares whole encodings would need hours for it, and serves no robot.
        if config.training_episodes and config.relevance is not Relevance.BRUTE_FORCE:
            with self._stage("train"):
                q_values, learning = train_nnql(
                    built.rehearsal,
                    partial(measured, training, self.evaluator, model),
                    built.second,
                    NnqlConfig(n_episodes=config.training_episodes, seed=config.seed),
                    self.progress.update,
                    self.n_threads,
                )
        asked = config.as_dict()
        landmarks_from = inputs.base or inputs.candidates
        weights_sha256 = training.weights_sha256 or (landmarks_from and landmarks_from.weights_sha256)
        if weights_sha256 is not None:
            asked["weights_sha256"] = weights_sha256
        map_ = replace(
            built.map,
            domain=domain.name,
            evaluator=domain.evaluator,
            config={**asked, **built.map.config},
            timestamp_us=training.timestamp_us if (training.timestamp_us != UNKNOWN_TIMESTAMP).any() else None,
            frame_digest=training.digests(),
            q_values=q_values,
        )
        second_season = None if built.same_route is None else built.same_route.as_dict()
        return _Draft(map_, asked, learning, second_season)

    def _appended(self, inputs: _Inputs, before: Map) -> _Draft:
        """A copy of the active map with the training traverse among its images."""
        config, drive = self.config, inputs.training
        record = self.catalog.map(self.domain, inputs.domain.active_version or 0)
        with self._stage("describe"):
            refuse_known_traverse(record.config, record.version, config.training_traverse)
            if before.frame_digest is not None and np.isin(drive.digests(), before.frame_digest).all():
                raise InvalidMapConfigError(
                    f"map {record.version}, which serves, holds every frame of traverse {config.training_traverse} "
                    "already, under another name: nothing is appended twice. Append another drive, or activate a map "
                    "without this one first",
                    traverse=config.training_traverse,
                    map_version=record.version,
                )
            _check_alike(before, config)
            map_ = append_drive(before, measured(drive, self.evaluator, before.landmark_model, self.progress.update))
        asked = config.as_dict()
        added = {"traverse": config.training_traverse, "n_frames": drive.n_frames, "to_version": record.version}
        # The catalog's configuration: the file of an imported map names traverses of another server.
        config_after = {
            **record.config,
            "n_landmarks": before.n_landmarks,
            **{name: asked[name] for name in ("append", "check_traverse", "gate_margin", "activate")},
            "appended": [*record.config.get("appended", ()), added],
        }
        weights_sha256 = drive.weights_sha256 or before.weights_sha256
        if weights_sha256 is not None:
            config_after["weights_sha256"] = weights_sha256
        metrics = record.metrics
        map_ = replace(map_, config=config_after)
        return _Draft(map_, config_after, metrics.get("training"), metrics.get("second_season"))

    def _checked(self, inputs: _Inputs, draft: _Draft) -> dict[str, Any]:
        """How the new map compares with the active one."""
        config, closed = self.config, inputs.domain.closed
        if config.check_traverse is not None and inputs.check is not None:
            frames = CheckFrames.of_traverse(config.check_traverse, inputs.check, closed)
        else:
            frames = CheckFrames.held_out(config.training_traverse, inputs.training, closed)
        traverses = traverses_in(draft.config)
        return check_map(
            self.catalog,
            self.domain,
            draft.map,
            traverses,
            frames,
            config.gate_margin,
            self.evaluator,
            self.progress.update,
        )


def refuse_known_traverse(config: Mapping[str, Any], version: int, name: str) -> None:
    """Refuse to append a traverse that a map holds by name, though it may hold other frames by now.

    Raises:
        InvalidMapConfigError: The map is made of a traverse of that name.
    """
    if name in traverses_in(config):
        raise InvalidMapConfigError(
            f"map {version}, which serves, holds traverse {name} already: nothing is appended twice. Append another "
            "drive (a new one needs a name of its own), or activate a map without this one first",
            traverse=name,
            map_version=version,
        )


def _check_alike(before: Map, config: RemapConfig) -> None:
    """What describes the images of one map is the same for all of them; what is left at its default is the map's.

    Raises:
        InvalidMapConfigError: Something else is asked for than the map has.
    """
    asked = {
        "n_landmarks": (config.n_landmarks, None, before.n_landmarks),
        "list_length": (config.list_length, DEFAULT_LIST_LENGTH, before.list_length),
        "relevance": (config.relevance.value, DEFAULT_RELEVANCE.value, before.relevance.value),
    }
    for name, (wanted, default, has) in asked.items():
        if wanted not in {default, has}:
            raise InvalidMapConfigError(
                f"the active map has {name} {has}, not {wanted}; what is appended to it must be alike", **{name: has}
            )
