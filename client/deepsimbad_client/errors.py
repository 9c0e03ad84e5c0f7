"""Every error the client raises, in one tree.

Three branches: what a recording on disk cannot give (`SourceError`), what the network did not deliver
(`TransportError`), and what the service answered (`ApiError`, one class per branch of the service's own tree,
chosen by the problem's stable `code` word and, for a code this version has not heard of, by the HTTP status).
"""

from collections.abc import Mapping
from typing import Any


class DeepSimbadClientError(Exception):
    """Root of the tree; `message` is one sentence that says what is wrong and what to do about it."""

    code: str = "client_error"

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


class MissingExtraError(DeepSimbadClientError):
    """A part of the client whose optional dependencies are not installed."""

    code = "missing_extra"


class InvalidArgumentError(DeepSimbadClientError, ValueError):
    """A value given to the client that can never be sent."""

    code = "invalid_argument"


class OtherWeightsError(DeepSimbadClientError):
    """The weights here are not those that the map's images were encoded by: ranks of both cannot be compared."""

    code = "other_weights"


class InvalidLandmarkModelError(DeepSimbadClientError):
    """A file or answer that is no landmark model, or one that this version cannot rank by."""

    code = "invalid_landmark_model"


class SourceError(DeepSimbadClientError):
    """A recording that cannot be read as a whole: missing, empty or inconsistent."""

    code = "invalid_source"


class BrokenFrameError(SourceError):
    """One frame of a recording that cannot be read; the rest of the recording is fine.

    Args:
        message: Which file, and what is wrong with it.
        reason: The words to count it under, beside a recording's `left_out`.
    """

    code = "broken_frame"

    def __init__(self, message: str, reason: str = "undecodable") -> None:
        super().__init__(message)
        self.reason = reason


class ReplayError(DeepSimbadClientError):
    """A replay that cannot go on or be scored."""

    code = "replay"


class TransportError(DeepSimbadClientError):
    """The request was sent as often as allowed and no answer came back."""

    code = "no_answer"


class TransportTimeoutError(TransportError):
    """The service did not answer within the time allowed."""

    code = "timeout"


class UnexpectedAnswerError(DeepSimbadClientError):
    """An answer that is not what the contract says: something else answers at this address."""

    code = "unexpected_answer"


class DamagedDownloadError(DeepSimbadClientError):
    """A file that came has another digest than the service named."""

    code = "damaged_download"


class NotSavedError(DeepSimbadClientError):
    """A file that cannot be written here."""

    code = "not_saved"


class NoEarlierMapError(DeepSimbadClientError):
    """There is no map to roll back to."""

    code = "no_earlier_map"


class JobFailedError(DeepSimbadClientError):
    """A job ended without success.

    Args:
        message: What the service said of it.
        job: The job as the service last described it (a `deepsimbad_client.models.Job`).
    """

    code = "job_failed"

    def __init__(self, message: str, job: Any) -> None:
        super().__init__(message)
        self.job = job


class JobCancelledError(JobFailedError):
    """A job was cancelled before it ended."""

    code = "cancelled"


class ApiError(DeepSimbadClientError):
    """The service answered with an error (RFC 9457 problem details).

    Args:
        message: The problem's detail, or the status line when the answer held none.
        status: The HTTP status.
        code: The problem's stable code word; `http_<status>` when the answer held none.
        problem: The whole problem document, with whatever limits and allowed values it names.
        request_id: The service's id of this request, to quote to its operator.
        retry_after_s: Seconds the service asked to wait before trying again.
    """

    def __init__(
        self,
        message: str,
        *,
        status: int,
        code: str = "",
        problem: Mapping[str, Any] | None = None,
        request_id: str | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.status = status
        self.code = code or f"http_{status}"
        self.problem: Mapping[str, Any] = dict(problem or {})
        self.request_id = request_id
        self.retry_after_s = retry_after_s

    @property
    def advice(self) -> str:
        """What the caller can do about it, where the service may not have said so; "" where there is nothing to add."""
        return ""

    def __str__(self) -> str:
        parts = [f"{self.status} {self.code}".strip()]
        if self.request_id:
            parts.append(f"request {self.request_id}")
        told = f"{self.message} ({', '.join(parts)})"
        return f"{told}; {self.advice}" if self.advice else told


class BadRequestError(ApiError):
    """400: the request could not be read at all."""


_KEY_ADVICE = (
    "`deepsimbad keys create --scope {scope}` makes one where the service runs; give it in $DEEPSIMBAD_API_KEY or "
    "--api-key"
)


class UnauthorizedError(ApiError):
    """401: no key, or one the service does not know."""

    @property
    def advice(self) -> str:
        """How to come by a key."""
        return _KEY_ADVICE.format(scope="localize|admin")


class ForbiddenError(ApiError):
    """403: the key lacks the scope this call needs."""

    @property
    def advice(self) -> str:
        """How to come by the right key."""
        return _KEY_ADVICE.format(scope=self.problem.get("needed", "admin"))


class NotFoundError(ApiError):
    """404: a name or id that nothing answers to."""


class UnknownDomainError(NotFoundError):
    """No such domain."""


class UnknownTraverseError(NotFoundError):
    """No such traverse in the domain."""


class UnknownJobError(NotFoundError):
    """No such job."""


class UnknownMapVersionError(NotFoundError):
    """No such map version in the domain."""


class UnknownSessionError(NotFoundError):
    """No such session, or one that ended long ago."""


class RequestTimeoutError(ApiError):
    """408: the request's bytes stopped coming, so the service gave it up."""


class ConflictError(ApiError):
    """409: the request is sound but the present state forbids it."""


class NoActiveMapError(ConflictError):
    """The domain has no active map yet."""


class DomainDiffersError(ConflictError):
    """A domain of that name exists with another configuration."""


class LandmarkModelDiffersError(ConflictError):
    """The view was ranked by another landmark model than that of the map that should answer: fetch that one.

    `problem` holds both digests, and the `map_version` to ask for.
    """

    @property
    def advice(self) -> str:
        """How to come by the right one."""
        return f"`client.on_board(domain, map_version={self.problem.get('map_version')})` fetches it"


class TraverseInUseError(ConflictError):
    """A running job still reads the traverse or domain."""


class LostActivationError(ConflictError):
    """The active map was not the expected one when the swap was tried."""


class MapInUseError(ConflictError):
    """The map version serves, is being built, or a living session keeps it."""


class TooManyDomainsError(ConflictError):
    """The service holds as many domains as it may."""


class GoneError(ApiError):
    """410: a retired map, or an expired or deleted session."""


class EndedSessionError(GoneError):
    """The session expired or was deleted: start another."""


class RetiredMapError(GoneError):
    """The map that the session began on is no more: start another session on the present one."""


class TooLargeError(ApiError):
    """413: more bytes or pixels than a limit allows."""


class HeadersTooLargeError(TooLargeError):
    """431: the request's headers, the key among them, are longer than the service takes."""


class UnsupportedMediaTypeError(ApiError):
    """415: a missing or unsupported content type."""


class InvalidInputError(ApiError):
    """422: a value or body that can never be accepted as it stands."""


class InvalidMoveError(InvalidInputError):
    """A move that is NaN, negative or longer than a robot may report."""


class PastTheEndError(InvalidMoveError):
    """A move that leads past the end of an open route wherever the robot may be."""


class InvalidPriorError(InvalidInputError):
    """A start or prior far off the route, or without a usable deviation."""


class IdempotencyKeyReusedError(InvalidInputError):
    """The idempotency key came before with another request."""


class RateLimitedError(ApiError):
    """429: too many requests; `retry_after_s` says how long to wait."""


class TooManySessionsError(RateLimitedError):
    """The service holds as many live sessions as it may."""


class TooManyJobsError(RateLimitedError):
    """As many jobs wait for their turn as may."""


class ServerError(ApiError):
    """5xx: the service failed."""


class UnavailableError(ServerError):
    """503: the service cannot answer now; its data is safe."""


class OverloadedError(UnavailableError):
    """More requests at once than the service answers in good time; `retry_after_s` says when to come again."""


class DamagedMapError(UnavailableError):
    """A map file on the server fails its digest or cannot be read."""


BY_CODE: Mapping[str, type[ApiError]] = {
    "unauthorized": UnauthorizedError,
    "forbidden": ForbiddenError,
    "request_timeout": RequestTimeoutError,
    "headers_too_large": HeadersTooLargeError,
    "rate_limited": RateLimitedError,
    "overloaded": OverloadedError,
    "map_in_use": MapInUseError,
    "too_many_domains": TooManyDomainsError,
    "unknown_domain": UnknownDomainError,
    "unknown_traverse": UnknownTraverseError,
    "unknown_job": UnknownJobError,
    "unknown_map_version": UnknownMapVersionError,
    "unknown_session": UnknownSessionError,
    "ended_session": EndedSessionError,
    "retired_map": RetiredMapError,
    "invalid_move": InvalidMoveError,
    "past_the_end": PastTheEndError,
    "invalid_prior": InvalidPriorError,
    "idempotency_key_reused": IdempotencyKeyReusedError,
    "too_many_sessions": TooManySessionsError,
    "too_many_jobs": TooManyJobsError,
    "no_active_map": NoActiveMapError,
    "domain_differs": DomainDiffersError,
    "landmark_model_differs": LandmarkModelDiffersError,
    "traverse_in_use": TraverseInUseError,
    "lost_activation": LostActivationError,
    "damaged_map": DamagedMapError,
}

BY_STATUS: Mapping[int, type[ApiError]] = {
    400: BadRequestError,
    401: UnauthorizedError,
    403: ForbiddenError,
    404: NotFoundError,
    408: RequestTimeoutError,
    409: ConflictError,
    410: GoneError,
    413: TooLargeError,
    415: UnsupportedMediaTypeError,
    422: InvalidInputError,
    429: RateLimitedError,
    431: HeadersTooLargeError,
    503: UnavailableError,
}


def api_error_class(status: int, code: str) -> type[ApiError]:
    """Choose the class for an answer: by its code word, else by its status, else by its hundred."""
    if code in BY_CODE:
        return BY_CODE[code]
    if status in BY_STATUS:
        return BY_STATUS[status]
    return ServerError if status >= 500 else ApiError
