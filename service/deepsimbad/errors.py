"""Every error the product names, in one tree without HTTP words.

A `code` is a stable word that scripts may test; `hints` carry what helps the reader to act (limits, allowed
values, the missing name). The API translates the branches to HTTP statuses in one table (`deepsimbad.api.problems`),
the command line to exit code 1 and one line on standard error.
"""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any, ClassVar


class DeepSimbadError(Exception):
    """Root of the tree.

    Args:
        message: One sentence that says what is wrong and what to do about it.
        **hints: JSON-ready facts that help (limits, allowed values, counts).
    """

    code: ClassVar[str] = "error"
    by_code: ClassVar[dict[str, type["DeepSimbadError"]]] = {}  # every class below the root

    def __init_subclass__(cls, *, code: str) -> None:
        cls.code = code
        cls.by_code[code] = cls

    def __init__(self, message: str, **hints: Any) -> None:
        super().__init__(message)
        self.message = message
        self.hints = hints


_MOST_NAMED, _LONGEST_WORD = 20, 100


def nearest_of(word: str, names: Iterable[str]) -> str:
    """The end of a message about an unknown word: the nearest of the names, and the first of all of them."""
    choices = list(names)
    if not choices:
        return ": there is none yet"
    matches = get_close_matches(word.lower(), choices, 1, 0.5) if len(word) <= _LONGEST_WORD else []
    listing = ", ".join(choices[:_MOST_NAMED]) + (", ..." if len(choices) > _MOST_NAMED else "")
    return f": did you mean {matches[0]}? There is {listing}" if matches else f": there is {listing}"


class InvalidInputError(DeepSimbadError, code="invalid_input"):
    """A value that can never be accepted as it stands."""


class UnknownParameterError(InvalidInputError, code="unknown_parameter"):
    """A query parameter that the call does not take."""


class EmptyBodyError(InvalidInputError, code="empty_body"):
    """An observation or frame without content."""


class InvalidImageError(InvalidInputError, code="undecodable_image"):
    """Bytes that are not an image we can decode."""


class TruncatedImageError(InvalidImageError, code="truncated_image"):
    """An image whose end is missing."""


class InvalidEncodingError(InvalidInputError, code="invalid_encoding"):
    """An encoding of the wrong length, or with NaN or infinity in it."""


class InvalidSceneError(InvalidInputError, code="invalid_scene"):
    """Objects or a text that tell no scene."""


class InvalidDissimilaritiesError(InvalidInputError, code="invalid_dissimilarities"):
    """Dissimilarities that are not r finite numbers."""


class InvalidRankedLandmarksError(InvalidInputError, code="invalid_ranked_landmarks"):
    """Ranked landmarks that are not 1..r distinct ids in range."""


class InvalidRouteError(InvalidInputError, code="invalid_route"):
    """Route positions that are NaN or go backwards."""


class InvalidMoveError(InvalidInputError, code="invalid_move"):
    """A move that is NaN, negative or longer than a robot may report."""


class PastTheEndError(InvalidMoveError, code="past_the_end"):
    """A move that leads past the end of an open route wherever the robot may be."""


class InvalidPriorError(InvalidInputError, code="invalid_prior"):
    """A start or prior far off the route, or without a usable deviation."""


class IdempotencyKeyReusedError(InvalidInputError, code="idempotency_key_reused"):
    """An idempotency key that came before with another request."""


class InvalidMapConfigError(InvalidInputError, code="invalid_map_config"):
    """Map parameters that contradict each other or the recordings."""


class TooFewCandidatesError(InvalidMapConfigError, code="too_few_candidates"):
    """Fewer landmark candidates than landmarks asked for."""


class TooFewToFitError(InvalidMapConfigError, code="too_few_to_fit"):
    """Fewer landmarks or frames than an evaluator can be fitted to."""


class InvalidSourceError(InvalidInputError, code="invalid_source"):
    """A recording that cannot be read."""


class InvalidWeightsError(InvalidInputError, code="invalid_weights"):
    """A file of weights that is truncated, of another family, of other shapes, unsafe, or fails its digest."""


class MissingWeightsError(InvalidInputError, code="missing_weights"):
    """A file of weights that is not there; the message says where to put it."""


class MissingPackageError(InvalidInputError, code="missing_package"):
    """A package that an extractor needs and that is not installed; the message says how to install it."""


class SettingsError(InvalidInputError, code="invalid_settings"):
    """A setting that cannot be used."""


class InvalidBatchError(InvalidInputError, code="invalid_batch"):
    """A batch of frames that is not an npz file of the arrays asked for."""


class InvalidArchiveError(InvalidInputError, code="invalid_archive"):
    """A backup or exported map that is not one, is incomplete or fails its digest."""


class NotFoundError(DeepSimbadError, code="not_found"):
    """A name or id that nothing answers to."""


class UnknownDomainError(NotFoundError, code="unknown_domain"):
    """No such domain."""


class UnknownThumbnailError(NotFoundError, code="unknown_thumbnail"):
    """No picture of a map image was kept."""


class UnknownTraverseError(NotFoundError, code="unknown_traverse"):
    """No such traverse in the domain."""


class UnknownJobError(NotFoundError, code="unknown_job"):
    """No such job."""


class UnknownMapVersionError(NotFoundError, code="unknown_map_version"):
    """No such map version in the domain."""


class UnknownSessionError(NotFoundError, code="unknown_session"):
    """No such session."""


class UnknownKeyError(NotFoundError, code="unknown_key"):
    """No such API key."""


class GoneError(DeepSimbadError, code="gone"):
    """Something that was there and is no more."""


class EndedSessionError(GoneError, code="ended_session"):
    """A session that expired or was deleted."""


class RetiredMapError(GoneError, code="retired_map"):
    """A map version whose file was removed, or a session on one."""


class BusyError(DeepSimbadError, code="busy"):
    """More than the service takes at once; the same request may succeed later."""


class TooManySessionsError(BusyError, code="too_many_sessions"):
    """The limit on live sessions is reached."""


class TooManyJobsError(BusyError, code="too_many_jobs"):
    """The limit on waiting jobs is reached."""


class RateLimitedError(BusyError, code="rate_limited"):
    """More requests in a row than one key may send."""


class ConflictError(DeepSimbadError, code="conflict"):
    """The request is sound but the present state forbids it."""


class NoActiveMapError(ConflictError, code="no_active_map"):
    """The domain has no active map yet."""


class NoDomainAnswersError(ConflictError, code="no_domain_answers"):
    """None of the domains that a view was asked of can answer it."""


class DomainDiffersError(ConflictError, code="domain_differs"):
    """A domain of that name exists with another configuration."""


class WeightsDifferError(ConflictError, code="weights_differ"):
    """A view, frame or traverse encoded by other weights than the map or traverse it should join."""

    @classmethod
    def check(cls, base: str, base_sha256: str | None, addition: str, addition_sha256: str | None) -> None:
        """Refuse an addition whose weights, by their SHA-256, are not those of the base; None is taken for equal."""
        if base_sha256 is not None and addition_sha256 is not None and base_sha256 != addition_sha256:
            raise cls(
                f"{addition} comes from other weights ({addition_sha256[:12]}...) than {base} "
                f"({base_sha256[:12]}...): their encodings cannot be compared. Bring the old weights back, or upload "
                "and map anew",
                known_weights_sha256=base_sha256,
                given_weights_sha256=addition_sha256,
            )


class SpoolFullError(ConflictError, code="spool_full"):
    """Images that wait to be fitted take all the room that they may."""


class LandmarkModelDiffersError(ConflictError, code="landmark_model_differs"):
    """A view ranked by another landmark model than that of the map that should answer."""


class FramesDifferError(ConflictError, code="frames_differ"):
    """Frames of other content, place or time than those of the same indices that are there already."""


class GreyLevelsDifferError(ConflictError, code="grey_levels_differ"):
    """Pictures shown by other grey levels than those of the traverse they should join."""


class TraverseInUseError(ConflictError, code="traverse_in_use"):
    """A running job still reads the traverse or domain."""


class LostActivationError(ConflictError, code="lost_activation"):
    """The active map was not the expected one when the swap was tried."""


class MapInUseError(ConflictError, code="map_in_use"):
    """The map version serves, or a session is pinned to it."""


class TooManyDomainsError(ConflictError, code="too_many_domains"):
    """The limit on domains is reached."""


class DataDirInUseError(ConflictError, code="data_dir_in_use"):
    """Another service runs on the data directory."""


class TooLargeError(DeepSimbadError, code="too_large"):
    """More than a limit allows."""


class BodyTooLargeError(TooLargeError, code="body_too_large"):
    """A request body over the byte limit."""


class ImageTooLargeError(TooLargeError, code="image_too_large"):
    """An image whose header claims more pixels than the limit."""


class NotAcceptableError(DeepSimbadError, code="not_acceptable"):
    """No answer of the kind that was asked for can be given."""


class UnsupportedMediaTypeError(DeepSimbadError, code="unsupported_media_type"):
    """A missing or unsupported content type."""


class AccessError(DeepSimbadError, code="access"):
    """A request that may not be made so."""


class UnauthorizedError(AccessError, code="unauthorized"):
    """No API key, or one that is unknown, revoked or expired."""


class ForbiddenError(AccessError, code="forbidden"):
    """An API key without the scope that the call needs."""


class ForeignHostError(ForbiddenError, code="foreign_host"):
    """A call that a page of another host may have sent to a service that asks for no key."""


class UnreadableRequestError(DeepSimbadError, code="unreadable_request"):
    """A request that can be read in two ways."""


class UnavailableError(DeepSimbadError, code="unavailable"):
    """The service cannot answer now; the data is safe."""


class OverloadedError(UnavailableError, code="overloaded"):
    """More requests at once than the service answers in good time."""


class OutOfMemoryError(UnavailableError, code="out_of_memory"):
    """Too little memory is left for a network; the view is not at fault."""


class EvaluatorUnavailableError(UnavailableError, code="evaluator_unavailable"):
    """A domain's extractor that cannot be loaded: its weights or a package are missing, or memory is short."""


class SessionMovedError(UnavailableError, code="session_moved"):
    """A session that another node moved on at the same moment; nothing was counted."""


class NotLoadedError(UnavailableError, code="not_loaded"):
    """A map that was not in memory when a view was asked of many, and could not be read in time or had no room."""


class DamagedMapError(UnavailableError, code="damaged_map"):
    """A map file that fails its digest or cannot be read."""


class DamagedFileError(UnavailableError, code="damaged_file"):
    """A catalog or traverse file that cannot be read, or that a newer release wrote."""


class JobInterruptedError(UnavailableError, code="job_interrupted"):
    """The process that ran the job ended before the job did."""


class CancelledError(DeepSimbadError, code="cancelled"):
    """The work was cancelled on request."""
