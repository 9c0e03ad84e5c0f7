"""Remapping a domain: from stored traverses to a sealed, active map version (design section 5).

A remap makes a map of its own, or appends a drive to a copy of the active one (`jobs.append`): no image is encoded
again, and where nothing is fused none is described again, and what two seasons taught stays.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, TypeAlias

import numpy as np

from deepsimbad.core.building import Built, MapPlan, SeenTwice
from deepsimbad.core.drive import Drive
from deepsimbad.core.experience.nnql import NnqlConfig
from deepsimbad.core.frames import Camera
from deepsimbad.core.landmark_model import fitting_number
from deepsimbad.core.map import Map
from deepsimbad.errors import (
    InvalidEncodingError,
    InvalidMapConfigError,
    LostActivationError,
    UnknownTraverseError,
    WeightsDifferError,
)
from deepsimbad.evaluators.base import Evaluator, Fitting, LandmarkModel
from deepsimbad.evaluators.grey_levels import with_levels
from deepsimbad.jobs.append import (
    ACTIVE_MAP,
    LANDMARK_TRAVERSE,
    TRAINING,
    KnownDrives,
    append_drive,
    camera_seasons,
    fuse,
    known_drives,
    refuse_known_traverse,
)
from deepsimbad.jobs.build import build, drive_in_space, measure_drive, train_nnql
from deepsimbad.jobs.check import CheckFrames, check_map
from deepsimbad.jobs.fitting import Fitter, Pictures, SpooledPictures, fitting_of
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_config import (
    DEFAULT_N_LANDMARKS,
    FIT,
    REMAP_STAGES,
    RemapConfig,
    check_alike,
    check_filled,
    staying_map,
)
from deepsimbad.jobs.versions import activate_once, seal_version
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
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
    pictures: Pictures | None = None,
) -> dict[str, Any]:
    """Build, seal and, if asked, activate the next map version of a domain.

    Nothing that serves changes before the last step, and a failed or cancelled remap leaves nothing behind. The last
    word wins: what was activated or rolled back while the remap ran gives way to the new map. With a gate the new map
    takes over only from the map it was compared with; else, or where it lost, it stays sealed and
    `metrics.check.why` says so.

    Args:
        progress: Reports the stages of REMAP_STAGES; may cancel.
        job_id: The job that this is: one that was interrupted after it sealed its version makes no other. None: none.
        pictures: Images of the drive that landmarks are chosen from, beside those that wait in its traverse.

    Returns:
        `{"map_version", "active", "metrics"}`, as the job's result.

    Raises:
        DeepSimbadError: Whatever is wrong with the traverses, the parameters or the storage, by name.
    """
    record = None if job_id is None else catalog.map_of_job(domain, job_id)
    if record is None:
        record = _Remap(catalog, domain, config, evaluator, progress, n_threads, pictures).seal(job_id)
    progress.stage("activate")
    for name in {config.training_traverse, config.landmark_traverse, config.check_traverse} - {None}:
        with suppress(UnknownTraverseError), Traverse.open(catalog.data_dir, domain, str(name)) as traverse:
            traverse.empty_spool()
    check = record.metrics["check"]
    is_active = config.activate and check["passed"] is not False
    if is_active:
        try:
            activate_once(catalog, domain, record, ANY if config.gate_margin is None else check["active_version"])
        except LostActivationError as error:
            is_active = False
            reason = f"{error.message}; the new map was compared with another one, and stays sealed"
            check = {**check, "why": reason}
    return {"map_version": record.version, "active": is_active, "metrics": {**record.metrics, "check": check}}


@dataclass(frozen=True)
class _Inputs:
    """What a remap reads before it begins."""

    domain: DomainRecord  # whose map it is
    training: Drive  # the traverse that becomes the map
    candidates: Drive | None  # the traverse landmarks are chosen from; None: those of `base` stay, or the training one
    base: Map | None  # the active map whose landmarks stay; None where they are chosen
    # The drive that the map learns from beside its own: the landmark traverse, else what the active map was made of;
    # None where there is none of the same encoder, or where frames are appended
    second: Drive | None
    camera: tuple[SeenTwice, ...]  # what the camera saw twice on another route
    # What `base` is made of, or why nothing can be fused; None: nothing is appended
    map_drives: KnownDrives | str | None
    check: Drive | None  # the drive that the new map is checked on; None: on frames of `training` that are held out


# A map that is not yet sealed, its version unknown; the map to check in its place, which does not know frames that are
# held out; its configuration as the catalog keeps it; and of its metrics `training`, how its experience was learnt,
# `second_season`, whether it learnt from one, both None where it did not, and `fused`, what became of a drive appended
_Draft: TypeAlias = tuple[Map, Map, dict[str, Any], dict[str, Any]]


@dataclass(frozen=True)
class _Remap:
    """One remap, with the arguments of `remap`; its methods are the stages."""

    catalog: Catalog
    domain: str
    config: RemapConfig
    evaluator: Evaluator
    progress: Progress
    n_threads: int
    pictures: Pictures | None

    def seal(self, job_id: str | None) -> MapRecord:
        """Build, check and seal the next version; what activates it later is read from its metrics."""
        config, progress = self.config, self.progress
        progress.stage("read frames")
        inputs = self._read()
        frames = CheckFrames.of(
            config.check_traverse or config.training_traverse,
            inputs.check or inputs.training,
            inputs.domain.closed,
            held_out=inputs.check is None,
        )
        if inputs.base is not None and config.append:
            map_, checked_map, record_config, results = self._append_traverse(inputs, inputs.base, frames)
        else:
            map_, checked_map, record_config, results = self._map_traverse(inputs)
        progress.stage("check")
        check = check_map(
            self.catalog,
            self.domain,
            checked_map,
            record_config,
            frames,
            config.gate_margin,
            self.evaluator,
            progress.update,
        )
        metrics = {
            "n_map_images": map_.n_images,
            "n_uninformative": int((inputs.training.shows_nothing | inputs.training.is_unlike_all).sum()),
            "n_landmarks": map_.n_landmarks,
            "seconds": progress.seconds({*REMAP_STAGES, FIT}),
            **results,
            "check": check,
            "warnings": [*results["warnings"], *self._warnings(inputs)],
        }
        progress.stage("seal")
        return seal_version(self.catalog, self.domain, map_, record_config, metrics, progress.update, job_id)

    def _warnings(self, inputs: _Inputs) -> list[str]:
        """Warnings of the drives' pictures and encodings: of drives that are not alike, or that show nothing."""
        training_camera, training_label = inputs.training.camera, f"those of traverse {self.config.training_traverse}"
        pairs: list[tuple[Drive | None, tuple[Camera | None, ...], str]]
        pairs = [
            (drive, (training_camera,), training_label) for drive in (inputs.candidates, inputs.second, inputs.check)
        ]
        if inputs.base is not None:
            pairs.append((inputs.training, inputs.base.cameras, "those of the active map"))
        warnings: dict[str, None] = {}  # in order, each once
        if not self.evaluator.forms:  # who encodes elsewhere may do so by two extractors
            for other in (inputs.candidates, inputs.second):
                if other is not None:
                    warnings |= dict.fromkeys(inputs.training.encoding_warnings(other))
        for drive, cameras, label in pairs:
            if drive is not None and drive.camera is not None:
                reason = drive.camera.unlike(filter(None, cameras), label)
                if reason is not None:
                    warnings[f"the pictures of traverse {drive.name} are not like {label}: {reason}"] = None
        return [*warnings, *inputs.training.picture_warnings("of the map")]

    def _read(self) -> _Inputs:
        """Read what is needed, every traverse once.

        Raises:
            UnknownDomainError, UnknownTraverseError: There is no such domain or traverse.
            InvalidMapConfigError: A traverse is empty, or no landmarks could stay.
            InvalidRouteError: The training or the check traverse goes backwards.
            InvalidEncodingError: The traverses come from two encoders.
            WeightsDifferError: Their images were encoded by other weights.
        """
        config, record = self.config, self.catalog.domain(self.domain)
        read = cache(self._drive)
        training = read(config.training_traverse)
        training.route(record.closed)  # raises here rather than after the map is built
        candidates = base = check = None
        camera: tuple[SeenTwice, ...] = ()
        if config.camera_of is not None:
            camera = camera_seasons(self.catalog, config.camera_of, record, training)
        if config.landmark_traverse is None:
            base = None if camera else self._base(record)
            if base is not None:
                label = f"traverse {config.training_traverse}"
                WeightsDifferError.check("the active map", base.weights_sha256, label, training.weights_sha256)
        else:
            candidates = read(config.landmark_traverse)
            self._check_encoder(config.landmark_traverse, candidates, training)
        if config.check_traverse is not None:
            check = read(config.check_traverse)
            self._check_encoder(config.check_traverse, check, training)
            check.route(record.closed)
        second = None if config.append else self._second_season(record, training, read)
        drives = (
            known_drives(self.catalog, record, base, training, read) if config.append and base is not None else None
        )
        return _Inputs(record, training, candidates, base, second, camera, drives, check)

    def _drive(self, name: str) -> Drive:
        with Traverse.open(self.catalog.data_dir, self.domain, name) as traverse:
            drive = traverse.read()
        check_filled(name, drive.n_frames)
        drive.check_differs(f"traverse {name}")
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
            config = self.catalog.map(record.name, record.active_version).config
            names = [config["training_traverse"], config["landmark_traverse"]]
        stored_names = Traverse.list(self.catalog.data_dir, record.name)
        for name in names:
            if name is not None and name != self.config.training_traverse and name in stored_names:
                second = read(name)
                weights = {second.weights_sha256, training.weights_sha256} - {None}
                if second.encoding_dim == training.encoding_dim and len(weights) <= 1:
                    return second  # else another encoder made it anew
        return None

    def _base(self, record: DomainRecord) -> Map | None:
        if record.active_version is None:
            if self.config.append:
                raise InvalidMapConfigError(f"domain {record.name} has no active map that could be appended to")
            return None
        return staying_map(self.config, read_map(self.catalog.map_file(record.name, record.active_version)))

    def _map_traverse(self, inputs: _Inputs) -> _Draft:
        """Map the training traverse by itself."""
        config, domain, training, base = self.config, inputs.domain, inputs.training, inputs.base
        map_build = self._build(inputs)
        q_values = learning = None
        # The baseline that compares whole encodings would need hours for it, and serves no robot.
        if config.training_episodes and config.relevance.traits.is_listed:
            self.progress.stage("train")
            q_values, learning = train_nnql(
                map_build.rehearsal,
                map_build.map_drive,
                map_build.second,
                NnqlConfig(n_episodes=config.training_episodes, seed=config.seed),
                self.progress.update,
                self.n_threads,
            )
        config_document = config.as_dict()
        landmark_source = base or inputs.candidates
        weights_sha256 = training.weights_sha256 or (landmark_source and landmark_source.weights_sha256)
        if weights_sha256 is not None:
            config_document["weights_sha256"] = weights_sha256
        if training.camera is not None:
            config_document["cameras"] = [training.camera.as_dict()]
        map_ = replace(
            map_build.map,
            domain=domain.name,
            evaluator=domain.evaluator,
            config={**config_document, **map_build.map.config},
            landmark_model=with_levels(map_build.map.landmark_model, training.grey_levels),
            **training.origins(),
            **({} if base is None else base.landmark_origins()),
            q_values=q_values,
        )
        same_route, second_season, warnings = map_build.same_route, None, list(map_build.warnings)
        if same_route is not None and inputs.second is not None:
            second_season = {**same_route.as_dict(), "traverse": inputs.second.name}
            warnings += same_route.remarks()
            if same_route.is_asked and not same_route.accepted:
                warnings.append(f"it learnt nothing of a second season: {same_route.why}")
        results = {
            "landmarks": ACTIVE_MAP if base else LANDMARK_TRAVERSE if inputs.candidates else TRAINING,
            "training": learning,
            "second_season": second_season,
            "camera_of": config.camera_of if map_build.by_camera else None,
            **({} if map_build.fitting is None else {"fitting": dict(map_build.fitting)}),
            "warnings": warnings,
        }
        return map_, map_, config_document, results

    def _build(self, inputs: _Inputs) -> Built:
        """Choose landmarks, fit the evaluator to them where it learns, and describe the training traverse by them."""
        config, domain, training, base = self.config, inputs.domain, inputs.training, inputs.base
        candidates = inputs.candidates or training
        landmarks: Drive | LandmarkModel | None = inputs.candidates
        n_landmarks = fitting_number(config.n_landmarks, candidates.n_frames, DEFAULT_N_LANDMARKS)
        if base is not None:
            landmarks, n_landmarks = base.landmark_model, base.n_landmarks
        plan = MapPlan(config.relevance, config.list_length, domain.actions_m, domain.closed, config.same_route)
        with Traverse.open(self.catalog.data_dir, self.domain, candidates.name or "") as traverse:
            fitter = Fitter(self.evaluator, SpooledPictures(traverse, candidates, self.pictures), config.seed)
            if base is None and fitting_of(self.evaluator, config.relevance) is not Fitting.NOTHING:
                self.progress.stage(FIT)
                other = inputs.second if candidates is training else training
                fitter.fit(plan, candidates, n_landmarks, other, self.progress.update)
            self.progress.stage("describe")
            return build(
                plan,
                training,
                inputs.second,
                landmarks,
                n_landmarks,
                self.evaluator,
                self.progress.update,
                inputs.camera,
                fitter,
            )

    def _append_traverse(self, inputs: _Inputs, old_map: Map, frames: CheckFrames) -> _Draft:
        """Fuse the training traverse into the images of a copy of the active map, or add its frames to them."""
        config, drive = self.config, inputs.training
        record = self.catalog.map(self.domain, inputs.domain.active_version or 0)
        self.progress.stage("describe")
        refuse_known_traverse(record, config.training_traverse)
        digests = [] if old_map.frame_digest is None else [old_map.frame_digest]
        if isinstance(inputs.map_drives, KnownDrives):
            digests += [season.digests() for season in inputs.map_drives.seasons]
        if digests and np.isin(drive.digests(), np.concatenate(digests)).all():
            raise InvalidMapConfigError(
                f"map {record.version}, which serves, holds every frame of traverse {config.training_traverse} "
                "already, under another name: nothing is appended twice. Append another drive, or activate a map "
                "without this one first",
                traverse=config.training_traverse,
                map_version=record.version,
            )
        check_alike(old_map, config)
        fused_map, verdict = None, {"accepted": False, "why": inputs.map_drives}
        warnings: tuple[str, ...] = ()
        if isinstance(inputs.map_drives, KnownDrives):
            drives, new_drive = self._in_space(old_map, inputs.map_drives, drive)
            fused_map, same_route = fuse(old_map, drives, new_drive, config.same_route)
            verdict, warnings = same_route.as_dict(), same_route.remarks()
        if fused_map is None:
            map_ = append_drive(
                old_map, measure_drive(drive, old_map.landmark_model, self.evaluator, self.progress.update)
            )
            appended = record.config.get("appended", ())
        else:
            map_, drives = fused_map.map, fused_map.known_drives
            agree = dict(zip((season.name for season in drives.seasons), drives.agree.tolist(), strict=True))
            appended = [
                earlier | {"fused": agree[earlier["traverse"]]} for earlier in record.config.get("appended", ())
            ]
        config_document = config.as_dict()
        entry = {"traverse": config.training_traverse, "n_frames": drive.n_frames, "to_version": record.version}
        entry["fused"] = fused_map is not None
        # The catalog's configuration: the file of an imported map names traverses of another server.
        new_config = {
            **record.config,
            "n_landmarks": old_map.n_landmarks,
            **{name: config_document[name] for name in ("append", "check_traverse", "gate_margin", "activate")},
            "appended": [*appended, entry],
        }
        weights_sha256 = drive.weights_sha256 or old_map.weights_sha256
        if weights_sha256 is not None:
            new_config["weights_sha256"] = weights_sha256
        if drive.camera is not None and drive.camera not in old_map.cameras:
            new_config["cameras"] = [camera.as_dict() for camera in (*old_map.cameras, drive.camera)]
        results = {name: record.metrics.get(name) for name in ("landmarks", "training", "second_season", "camera_of")}
        results["fused"] = {**verdict, "n_new_images": map_.n_images - old_map.n_images}
        results["warnings"] = warnings
        checked_map = fused_map.without(frames.withheld) if fused_map is not None and frames.is_held_out else map_
        return replace(map_, config=new_config), checked_map, new_config, results

    def _in_space(self, old_map: Map, drives: KnownDrives, drive: Drive) -> tuple[KnownDrives, Drive]:
        """The drives that a map is made of and the one that joins it, as `drive_in_space`."""
        in_space = cache(partial(drive_in_space, model=old_map.landmark_model, evaluator=self.evaluator))
        candidates = None if drives.candidates is None else in_space(drives.candidates)
        seasons = tuple(map(in_space, drives.seasons))
        return replace(drives, seasons=seasons, candidates=candidates, halves=self.evaluator.halves), in_space(drive)
