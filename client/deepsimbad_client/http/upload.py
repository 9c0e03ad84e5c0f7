"""Upload of a recording to a traverse, resumed where an earlier attempt stopped."""

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
from deepsimbad_client.recordings import Frame, LeftOut, Recording, columns_of, first_names, spread
from deepsimbad_client.recordings.annotations import as_taken

BATCH_BYTES = 8 * 2**20  # Size of a batch of ready encodings: worth its round trip, and lost cheaply on a thin link
CONCURRENCY = 4
UNUSABLE_IMAGE_CODES = frozenset({"undecodable_image", "truncated_image", "empty_body", "invalid_scene"})

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass
class UploadReport:
    """How many of a recording's frames were sent, skipped, broken and left out."""

    n_frames: int  # that could be sent
    n_sent: int = 0  # by this run
    n_skipped: int = 0  # the service had them already, equal
    n_broken: Counter[str] = field(default_factory=Counter)  # could not be sent, by reason
    broken_names: list[str] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)  # by the reader before, by reason
    left_out_names: dict[str, list[str]] = field(default_factory=dict)  # both kinds, by reason
    bytes_sent: int = 0  # of images and encodings
    warnings: tuple[str, ...] = ()  # of the service, about the traverse's pictures
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
    on_progress: Callable[[UploadReport], None] = lambda _: None,
) -> UploadReport:
    """Send the frames of a recording that the service does not have yet.

    Images go one by one, a few at once, resized to what the domain asks for; ready encodings go in batches. A frame
    that cannot be read here, or decoded there, is counted and passed over.

    The domain must exist, the traverse is made. Frames that are there already are compared by place, time and content:
    equal ones are passed over; others raise OtherFramesError before anything is sent, or are replaced with `replace`.
    `on_progress` is called with the report after every frame or batch. Raises SourceError (without `allow_missing` also
    as soon as more than a twentieth of the recording is left out), ApiError, TransportError.
    """
    if not recording.frames:
        raise SourceError(f"{recording.name} has no frames to send")
    left_out = LeftOut(recording, allow_missing=allow_missing)
    start_s = time.monotonic()
    domain_answer = client.domain(domain)
    recording, input_size = as_taken(recording, domain_answer.takes), domain_answer.input_size
    stored_traverse = client.admin.create_traverse(domain, traverse, grey_levels=recording.grey_levels)
    recording = recording.shown_by(stored_traverse.grey_levels)
    report = UploadReport(len(recording.frames), left_out=recording.left_out, left_out_names=left_out.names)
    on_progress(report)
    stored_columns = client.admin.frames(domain, traverse)
    comparison = Comparison(recording, stored_columns)
    for _ in comparison.read_digests(input_size, concurrency):
        report.n_skipped += 1
        on_progress(report)
    replaced_rows = comparison.rows_to_replace(f"{domain}/{traverse}", replace=replace)
    _check_unsent(recording, stored_columns, f"{domain}/{traverse}", input_size)
    equal_rows = set(comparison.rows) - replaced_rows
    rows = [row for row in range(len(recording.frames)) if row not in equal_rows]
    report.n_skipped = len(equal_rows)
    if recording.encodings is not None:
        batch_size = max(1, BATCH_BYTES // max(1, 4 * recording.encodings.shape[1]))
        for start in range(0, len(rows), batch_size):
            batch = rows[start : start + batch_size]
            values, frames = recording.encodings[batch], [recording.frames[row] for row in batch]
            names = [frame.name for frame in frames]
            columns = columns_of(frames)
            client.admin.put_frames(domain, traverse, encodings=values, name=names, replace=replace, **columns)
            report.n_sent += len(batch)
            report.bytes_sent += values.nbytes
            on_progress(report)
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
            on_progress(report)
    report.warnings = client.admin.traverse(domain, traverse).warnings
    report.seconds = time.monotonic() - start_s
    if report.n_sent + report.n_skipped == 0:
        reasons = ", ".join(f"{count} {reason}" for reason, count in report.n_broken.items())
        raise SourceError(f"none of the {report.n_frames} frames of {recording.name} could be sent: {reasons}")
    return report


class Comparison:
    """A recording compared with the frames that its traverse holds, `stored` as from `Admin.frames`."""

    def __init__(self, recording: Recording, stored_columns: Mapping[str, NDArray[Any]]) -> None:
        row_of = {index: row for row, index in enumerate(stored_columns["index"].tolist())}
        self.rows = [row for row, frame in enumerate(recording.frames) if frame.index in row_of]  # that are stored
        self._n_unsent = len(row_of) - len(self.rows)
        self._recording = recording
        frames = [recording.frames[row] for row in self.rows]
        stored_rows = [row_of[frame.index] for frame in frames]
        self._stored = {name: stored_columns[name][stored_rows] for name in IDENTITY}
        self._columns = {**columns_of(frames), "content_digest": np.full(len(frames), UNKNOWN_CONTENT, np.uint64)}

    def read_digests(
        self, input_size: tuple[int, int] | None, concurrency: int, places: Sequence[int] | None = None
    ) -> Iterator[int]:
        """Read the digest of every frame whose stored digest is known, and yield its row; a broken one stays unknown.

        `places` are the indices into `rows` that are read; None: all.
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

        for place, frame_digest in in_order(digest, range(len(self.rows)) if places is None else places, concurrency):
            self._columns["content_digest"][place] = frame_digest
            yield self.rows[place]

    def difference_masks(self) -> dict[str, NDArray[np.bool_]]:
        """By what differs, in words: [n] which of `rows` differ so from the stored frames; empty where none does."""
        return differences(self._columns, self._stored)

    def rows_to_replace(self, traverse: str, *, replace: bool) -> set[int]:
        """Rows of the frames that differ from the stored ones; raises OtherFramesError where they may not be replaced.

        Without `replace` they may not, nor where the traverse holds frames that the recording lacks: it would be made
        of two recordings.
        """
        masks = self.difference_masks()
        if not masks:
            return set()
        rows = [self.rows[place] for place in np.flatnonzero(np.any(list(masks.values()), axis=0))]
        names = [self._recording.frames[row].name for row in rows]
        if replace and not self._n_unsent:
            return set(rows)
        raise OtherFramesError(
            f"traverse {traverse} holds other frames than {self._recording.name}: {len(rows)} of the {len(self.rows)} "
            f"that both have differ in {', '.join(masks)} ({first_names(names)}), and nothing was sent: "
            + (
                f"{self._n_unsent} frames there are not of this recording, so {_advice(traverse)}"
                if replace
                else "--replace puts these in their place, or choose another --traverse"
            ),
            names,
        )


def _check_unsent(
    recording: Recording, stored_columns: Mapping[str, NDArray[Any]], traverse: str, input_size: tuple[int, int] | None
) -> None:
    """Check that stored frames which a slice leaves unsent are those of its full recording; raises OtherFramesError.

    They must be equal by place and time, a few also by content.
    """
    full, sent_indices = recording.full_recording or recording, {frame.index for frame in recording.frames}
    unsent_rows = [row for row, index in enumerate(stored_columns["index"].tolist()) if index not in sent_indices]
    if not unsent_rows:
        return
    unsent_columns = {name: stored_columns[name][unsent_rows] for name in ("index", *IDENTITY)}
    indices = set(unsent_columns["index"].tolist())
    rest_rows = [row for row, frame in enumerate(full.frames) if frame.index in indices]
    if not rest_rows and len(unsent_rows) < len(stored_columns["index"]):
        return  # the stored frames go on behind the recording's end, and the common ones are compared already
    if rest_rows:
        frames = [full.frames[row] for row in rest_rows]
        encodings = None if full.encodings is None else full.encodings[rest_rows]
        comparison = Comparison(
            dataclasses.replace(full, frames=frames, encodings=encodings, full_recording=None), unsent_columns
        )
        for _ in comparison.read_digests(input_size, 1, spread(len(rest_rows))):
            pass
        if not comparison.difference_masks():
            return
    names = [frame.name for frame in recording.frames[:1]]
    raise OtherFramesError(
        f"traverse {traverse} holds frames of another recording than {recording.name}: {len(unsent_rows)} beside those "
        f"to be sent, which the rest of it does not equal, and nothing was sent: {_advice(traverse)}",
        names,
    )


def _advice(traverse: str) -> str:
    domain, _, name = traverse.partition("/")
    return f"delete it first (`deepsimbad-client delete-traverse {domain} {name}`) or choose another --traverse"


def in_order(work: Callable[[Item], Result], items: Iterable[Item], concurrency: int) -> Iterator[tuple[Item, Result]]:
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
            domain,
            traverse,
            frame.index,
            image.body,
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
