"""Send a recording to a traverse, going on where an earlier attempt stopped."""

import dataclasses
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.frames import IDENTITY, UNKNOWN_CONTENT, content_digest, differences
from deepsimbad_client.errors import BrokenFrameError, InvalidInputError, OtherFramesError, SourceError
from deepsimbad_client.http.client import Client
from deepsimbad_client.recordings import Frame, LeftOut, Recording, columns_of, shown, spread
from deepsimbad_client.recordings.told import as_taken

BATCH_BYTES = 8 * 2**20  # Size of a batch of ready encodings: worth its round trip, and lost cheaply on a thin link
CONCURRENCY = 4
UNUSABLE_IMAGE_CODES = frozenset({"undecodable_image", "truncated_image", "empty_body", "invalid_scene"})

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass
class UploadReport:
    """What has become of a recording's frames."""

    n_frames: int  # that could be sent
    n_sent: int = 0  # by this run
    n_skipped: int = 0  # which the service had already, equal
    n_broken: Counter[str] = field(default_factory=Counter)  # could not be sent, by reason; the others go on
    broken_names: list[str] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)  # by the reader before, by reason
    left_out_names: dict[str, list[str]] = field(default_factory=dict)  # both kinds, by reason
    bytes_sent: int = 0  # of images and encodings
    warnings: tuple[str, ...] = ()  # of the service, about the pictures that are there
    seconds: float = 0.0

    @property
    def n_done(self) -> int:
        """Frames sent, skipped or broken."""
        return self.n_sent + self.n_skipped + self.n_broken.total()

    def as_dict(self) -> dict[str, object]:
        """The report, JSON-ready."""
        return {**vars(self), "seconds": round(self.seconds, 3)}


def upload(
    client: Client,
    recording: Recording,
    domain: str,
    traverse: str,
    *,
    concurrency: int = CONCURRENCY,
    replace: bool = False,
    allow_missing: bool = True,
    on_progress: Callable[[UploadReport], None] | None = None,
) -> UploadReport:
    """Send the frames of a recording that the service does not have yet.

    Images go one by one, a few at once, resized to what the domain asks for; ready encodings go in batches. A frame
    that cannot be read here, or decoded there, is counted and passed over.

    The domain must exist, the traverse is made. Frames that are there already are compared by place, time and content:
    equal ones are passed over; others raise OtherFramesError before anything is sent, or are replaced with `replace`.
    `on_progress` is told how far it is after every frame or batch. Raises SourceError (without `allow_missing` also as
    soon as more than a twentieth of the recording is left out), ApiError, TransportError.
    """
    if not recording.frames:
        raise SourceError(f"{recording.name} has no frames to send")
    left_out = LeftOut(recording, allow_missing=allow_missing)
    started = time.monotonic()
    described = client.domain(domain)
    recording, input_size = as_taken(recording, described.takes), described.input_size
    stored = client.admin.create_traverse(domain, traverse, grey_levels=recording.grey_levels)
    recording = recording.shown_by(stored.grey_levels)
    report = UploadReport(len(recording.frames), left_out=recording.left_out, left_out_names=left_out.names)

    def tell() -> None:
        if on_progress is not None:
            on_progress(report)

    tell()
    known = client.admin.frames(domain, traverse)
    there = Comparison(recording, known)
    for _ in there.reading(input_size, concurrency):
        report.n_skipped += 1
        tell()
    others = there.others(f"{domain}/{traverse}", replace=replace)
    _check_beside(recording, known, f"{domain}/{traverse}", input_size)
    equal = set(there.rows) - others
    rows = [row for row in range(len(recording.frames)) if row not in equal]
    report.n_skipped = len(equal)
    if recording.encodings is not None:
        batch_size = max(1, BATCH_BYTES // max(1, 4 * recording.encodings.shape[1]))
        for start in range(0, len(rows), batch_size):
            batch = rows[start : start + batch_size]
            values, frames = recording.encodings[batch], [recording.frames[row] for row in batch]
            names = [frame.name for frame in frames]
            known = columns_of(frames)
            client.admin.put_frames(domain, traverse, encodings=values, name=names, replace=replace, **known)
            report.n_sent += len(batch)
            report.bytes_sent += values.nbytes
            tell()
    else:
        send = partial(_send_image, client, recording, domain, traverse, input_size, replace)
        for frame, outcome in in_order(send, [recording.frames[row] for row in rows], concurrency):
            if isinstance(outcome, int):
                report.n_sent += 1
                report.bytes_sent += outcome
            else:
                report.n_broken[outcome] += 1
                report.broken_names.append(frame.name)
                left_out.add(outcome, frame.name)
            tell()
    report.warnings = client.admin.traverse(domain, traverse).warnings
    report.seconds = time.monotonic() - started
    if report.n_sent + report.n_skipped == 0:
        reasons = ", ".join(f"{count} {reason}" for reason, count in report.n_broken.items())
        raise SourceError(f"none of the {report.n_frames} frames of {recording.name} could be sent: {reasons}")
    return report


class Comparison:
    """A recording beside the frames that its traverse holds, known as `Admin.frames` tells."""

    def __init__(self, recording: Recording, known: Mapping[str, NDArray[Any]]) -> None:
        row_of = {index: row for row, index in enumerate(known["index"].tolist())}
        self.rows = [row for row, frame in enumerate(recording.frames) if frame.index in row_of]  # those it holds
        self._n_beside = len(row_of) - len(self.rows)
        self._recording = recording
        frames = [recording.frames[row] for row in self.rows]
        at = [row_of[frame.index] for frame in frames]
        self._stored = {name: known[name][at] for name in IDENTITY}
        self._own = {**columns_of(frames), "content_digest": np.full(len(frames), UNKNOWN_CONTENT, np.uint64)}

    def reading(
        self, input_size: tuple[int, int] | None, concurrency: int, places: Sequence[int] | None = None
    ) -> Iterator[int]:
        """Take the digest of every frame whose stored one is known, and tell its row; a broken one stays unknown.

        `places` are those of `rows` that are read; None: all.
        """

        def digest(place: int) -> int:
            row = self.rows[place]
            if self._stored["content_digest"][place] == UNKNOWN_CONTENT:
                return UNKNOWN_CONTENT
            if self._recording.encodings is not None:
                return content_digest(np.asarray(self._recording.encodings[row], "<f4").tobytes())
            try:
                return content_digest(self._recording.image(self._recording.frames[row], input_size).body)
            except BrokenFrameError:
                return UNKNOWN_CONTENT

        for place, found in in_order(digest, range(len(self.rows)) if places is None else places, concurrency):
            self._own["content_digest"][place] = found
            yield self.rows[place]

    def differing(self) -> dict[str, NDArray[np.bool_]]:
        """In what which of `rows` differ from those there."""
        return differences(self._own, self._stored)

    def others(self, traverse: str, *, replace: bool) -> set[int]:
        """Rows of the frames that differ from those there; raises OtherFramesError where these may not be replaced.

        Nor may they where the traverse holds frames that the recording lacks: it would be made of two.
        """
        differ = self.differing()
        if not differ:
            return set()
        rows = [self.rows[place] for place in np.flatnonzero(np.any(list(differ.values()), axis=0))]
        names = [self._recording.frames[row].name for row in rows]
        if replace and not self._n_beside:
            return set(rows)
        raise OtherFramesError(
            f"traverse {traverse} holds other frames than {self._recording.name}: {len(rows)} of the {len(self.rows)} "
            f"that both have differ in {', '.join(differ)} ({shown(names)}), and nothing was sent: "
            + (
                f"{self._n_beside} frames there are not of this recording, so {_apart(traverse)}"
                if replace
                else "--replace puts these in their place, or choose another --traverse"
            ),
            names,
        )


def _check_beside(
    recording: Recording, known: Mapping[str, NDArray[Any]], traverse: str, input_size: tuple[int, int] | None
) -> None:
    """Refuse a slice where the frames stored beside it are another recording's than the rest of its own.

    They must be equal by place and time, a few also by content. Raises OtherFramesError.
    """
    whole, sliced = recording.whole or recording, {frame.index for frame in recording.frames}
    beside = [row for row, index in enumerate(known["index"].tolist()) if index not in sliced]
    if not beside:
        return
    stored = {name: known[name][beside] for name in ("index", *IDENTITY)}
    indices = set(stored["index"].tolist())
    rest = [row for row, frame in enumerate(whole.frames) if frame.index in indices]
    if not rest and len(beside) < len(known["index"]):
        return  # the stored ones go on behind the recording's end, and what both have is compared
    if rest:
        frames = [whole.frames[row] for row in rest]
        encodings = None if whole.encodings is None else whole.encodings[rest]
        other = Comparison(dataclasses.replace(whole, frames=frames, encodings=encodings, whole=None), stored)
        for _ in other.reading(input_size, 1, spread(len(rest))):
            pass
        if not other.differing():
            return
    names = [frame.name for frame in recording.frames[:1]]
    raise OtherFramesError(
        f"traverse {traverse} holds frames of another recording than {recording.name}: {len(beside)} beside those to "
        f"be sent, which the rest of it does not equal, and nothing was sent: {_apart(traverse)}",
        names,
    )


def _apart(traverse: str) -> str:
    domain, _, name = traverse.partition("/")
    return f"delete it first (`deepsimbad-client delete-traverse {domain} {name}`) or choose another --traverse"


def in_order(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    concurrency: int,
) -> Iterator[tuple[Item, Result]]:
    """Yield (item, work(item)) in the items' order, with at most `concurrency` at work and as many waiting.

    The first failure is raised in its turn; what has not begun by then never begins. So it is when the caller stops.
    """
    executor = ThreadPoolExecutor(max_workers=concurrency, thread_name_prefix="deepsimbad-client")
    pending: deque[tuple[Item, Future[Result]]] = deque()
    try:
        for item in items:
            pending.append((item, executor.submit(work, item)))
            if len(pending) >= 2 * concurrency:
                first, future = pending.popleft()
                yield first, future.result()
        while pending:
            first, future = pending.popleft()
            yield first, future.result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _send_image(
    client: Client,
    recording: Recording,
    domain: str,
    traverse: str,
    input_size: tuple[int, int] | None,
    replace: bool,
    frame: Frame,
) -> int | str:
    """Send one frame; returns its bytes, or the reason why it is broken."""
    try:
        image = recording.image(frame, input_size)
        client.admin.put_frame(
            *(domain, traverse, frame.index, image.body),
            content_type=image.content_type,
            position_m=frame.position_m,
            timestamp_us=frame.timestamp_us,
            x_m=frame.x_m,
            y_m=frame.y_m,
            name=frame.name,
            camera=recording.camera if image.content_type.startswith("image/") else None,
            replace=replace,
        )
    except BrokenFrameError as error:
        return error.reason
    except InvalidInputError as error:
        if error.code not in UNUSABLE_IMAGE_CODES:
            raise
        return f"refused by the service as {error.code}"
    return len(image.body)
