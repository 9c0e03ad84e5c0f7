"""Every error the product names, in one tree without HTTP words.

A `code` is a stable word that scripts may test; `hints` carry what helps the reader to act (limits, allowed
values, the missing name). The API translates the branches to HTTP statuses in one table (`deepsimbad.api.problems`),
the command line to exit code 1 and one line on standard error.
"""

from typing import Any, ClassVar


class DeepSimbadError(Exception):
    """Root of the tree.

    Args:
        message: One sentence that says what is wrong and what to do about it.
        **hints: JSON-ready facts that help (limits, allowed values, counts).
    """

    code: ClassVar[str] = "error"

    def __init__(self, message: str, **hints: Any) -> None:
        super().__init__(message)
        self.message = message
        self.hints = hints


class InvalidInputError(DeepSimbadError):
    """A value that can never be accepted as it stands."""

    code = "invalid_input"


class EmptyBodyError(InvalidInputError):
    """An observation or frame without content."""

    code = "empty_body"


class InvalidImageError(InvalidInputError):
    """Bytes that are not an image we can decode."""

    code = "undecodable_image"


class TruncatedImageError(InvalidImageError):
    """An image whose end is missing."""

    code = "truncated_image"


class InvalidEncodingError(InvalidInputError):
    """An encoding of the wrong length, or with NaN or infinity in it."""

    code = "invalid_encoding"


class InvalidDissimilaritiesError(InvalidInputError):
    """Dissimilarities that are not r finite numbers."""

    code = "invalid_dissimilarities"


class InvalidRankedLandmarksError(InvalidInputError):
    """Ranked landmarks that are not 1..r distinct ids in range."""

    code = "invalid_ranked_landmarks"


class InvalidRouteError(InvalidInputError):
    """Route positions that are NaN or go backwards."""

    code = "invalid_route"


class InvalidMoveError(InvalidInputError):
    """A move that is NaN, negative or longer than a robot may report."""

    code = "invalid_move"


class PastTheEndError(InvalidMoveError):
    """A move that leads past the end of an open route wherever the robot may be."""

    code = "past_the_end"


class InvalidPriorError(InvalidInputError):
    """A start or prior far off the route, or without a usable deviation."""

    code = "invalid_prior"


class IdempotencyKeyReusedError(InvalidInputError):
    """An idempotency key that came before with another request."""

    code = "idempotency_key_reused"


class InvalidMapConfigError(InvalidInputError):
    """Map parameters that contradict each other or the recordings."""

    code = "invalid_map_config"


class TooFewCandidatesError(InvalidMapConfigError):
    """Fewer landmark candidates than landmarks asked for."""

    code = "too_few_candidates"


class InvalidSourceError(InvalidInputError):
    """A recording that cannot be read."""

    code = "invalid_source"


class InvalidWeightsError(InvalidInputError):
    """A file of weights that is truncated, of another family, of other shapes, unsafe, or fails its digest."""

    code = "invalid_weights"


class MissingWeightsError(InvalidInputError):
    """A file of weights that is not there; the message says where to put it."""

    code = "missing_weights"


class MissingPackageError(InvalidInputError):
    """A package that an extractor needs and that is not installed; the message says how to install it."""

    code = "missing_package"


class SettingsError(InvalidInputError):
    """A setting that cannot be used."""

    code = "invalid_settings"


class InvalidArchiveError(InvalidInputError):
    """A backup or exported map that is not one, is incomplete or fails its digest."""

    code = "invalid_archive"


class NotFoundError(DeepSimbadError):
    """A name or id that nothing answers to."""

    code = "not_found"


class UnknownDomainError(NotFoundError):
    """No such domain."""

    code = "unknown_domain"


class UnknownTraverseError(NotFoundError):
    """No such traverse in the domain."""

    code = "unknown_traverse"


class UnknownJobError(NotFoundError):
    """No such job."""

    code = "unknown_job"


class UnknownMapVersionError(NotFoundError):
    """No such map version in the domain."""

    code = "unknown_map_version"


class UnknownSessionError(NotFoundError):
    """No such session."""

    code = "unknown_session"


class UnknownKeyError(NotFoundError):
    """No such API key."""

    code = "unknown_key"


class GoneError(DeepSimbadError):
    """Something that was there and is no more."""

    code = "gone"


class EndedSessionError(GoneError):
    """A session that expired or was deleted."""

    code = "ended_session"


class RetiredMapError(GoneError):
    """A map version whose file was removed, or a session on one."""

    code = "retired_map"


class BusyError(DeepSimbadError):
    """More than the service takes at once; the same request may succeed later."""

    code = "busy"


class TooManySessionsError(BusyError):
    """The limit on live sessions is reached."""

    code = "too_many_sessions"


class TooManyJobsError(BusyError):
    """The limit on waiting jobs is reached."""

    code = "too_many_jobs"


class RateLimitedError(BusyError):
    """More requests in a row than one key may send."""

    code = "rate_limited"


class ConflictError(DeepSimbadError):
    """The request is sound but the present state forbids it."""

    code = "conflict"


class NoActiveMapError(ConflictError):
    """The domain has no active map yet."""

    code = "no_active_map"


class DomainDiffersError(ConflictError):
    """A domain of that name exists with another configuration."""

    code = "domain_differs"


class WeightsDifferError(ConflictError):
    """A view, frame or traverse encoded by other weights than the map or traverse it should join."""

    code = "weights_differ"

    @classmethod
    def check(cls, what: str, known: str | None, given_to: str, given: str | None) -> None:
        """Refuse to bring together encodings of two networks; what nobody knows is believed.

        Args:
            what: Whose weights are known, as a sentence would name it.
            known: Their SHA-256; None: unknown, or there are none.
            given_to: What should join it.
            given: The SHA-256 of its weights.
        """
        if known is not None and given is not None and known != given:
            raise cls(
                f"{given_to} comes from other weights ({given[:12]}...) than {what} ({known[:12]}...): their encodings "
                "cannot be compared. Bring the old weights back, or upload and map anew",
                known_weights_sha256=known,
                given_weights_sha256=given,
            )


class LandmarkModelDiffersError(ConflictError):
    """A view ranked by another landmark model than that of the map that should answer."""

    code = "landmark_model_differs"


class TraverseInUseError(ConflictError):
    """A running job still reads the traverse or domain."""

    code = "traverse_in_use"


class LostActivationError(ConflictError):
    """The active map was not the expected one when the swap was tried."""

    code = "lost_activation"


class MapInUseError(ConflictError):
    """The map version serves, or a session is pinned to it."""

    code = "map_in_use"


class TooManyDomainsError(ConflictError):
    """The limit on domains is reached."""

    code = "too_many_domains"


class DataDirInUseError(ConflictError):
    """Another service runs on the data directory."""

    code = "data_dir_in_use"


class TooLargeError(DeepSimbadError):
    """More than a limit allows."""

    code = "too_large"


class BodyTooLargeError(TooLargeError):
    """A request body over the byte limit."""

    code = "body_too_large"


class ImageTooLargeError(TooLargeError):
    """An image whose header claims more pixels than the limit."""

    code = "image_too_large"


class UnsupportedMediaTypeError(DeepSimbadError):
    """A missing or unsupported content type."""

    code = "unsupported_media_type"


class AccessError(DeepSimbadError):
    """A request that may not be made so."""

    code = "access"


class UnauthorizedError(AccessError):
    """No API key, or one that is unknown, revoked or expired."""

    code = "unauthorized"


class ForbiddenError(AccessError):
    """An API key without the scope that the call needs."""

    code = "forbidden"


class ForeignHostError(ForbiddenError):
    """A call that a page of another host may have sent to a service that asks for no key."""

    code = "foreign_host"


class UnreadableRequestError(DeepSimbadError):
    """A request that can be read in two ways."""

    code = "unreadable_request"


class UnavailableError(DeepSimbadError):
    """The service cannot answer now; the data is safe."""

    code = "unavailable"


class OverloadedError(UnavailableError):
    """More requests at once than the service answers in good time."""

    code = "overloaded"


class OutOfMemoryError(UnavailableError):
    """Too little memory is left for a network; the view is not at fault."""

    code = "out_of_memory"


class EvaluatorUnavailableError(UnavailableError):
    """A domain's extractor that cannot be loaded: its weights or a package are missing, or memory is short."""

    code = "evaluator_unavailable"


class DamagedMapError(UnavailableError):
    """A map file that fails its digest or cannot be read."""

    code = "damaged_map"


class DamagedFileError(UnavailableError):
    """A catalog or traverse file that cannot be read, or that a newer release wrote."""

    code = "damaged_file"


class JobInterruptedError(UnavailableError):
    """The process that ran the job ended before the job did."""

    code = "job_interrupted"


class CancelledError(DeepSimbadError):
    """The work was cancelled on request."""

    code = "cancelled"
