"""The tree of all errors that the client raises: of recordings, of the network, of the service's answers."""

from collections.abc import Mapping, Sequence
from typing import Any


class DeepSimbadClientError(Exception):
    """Root of the tree; `message` is one sentence that says what is wrong and what to do about it."""

    code: str = "client_error"

    def __init_subclass__(cls, code: str = "") -> None:
        super().__init_subclass__()
        cls.code = code or cls.code

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


class MissingExtraError(DeepSimbadClientError, code="missing_extra"):
    """A part of the client whose optional dependencies are not installed."""


class InvalidArgumentError(DeepSimbadClientError, ValueError, code="invalid_argument"):
    """A value given to the client that can never be sent."""


class OtherWeightsError(DeepSimbadClientError, code="other_weights"):
    """The weights here are not those that the map's images were encoded by: ranks of both cannot be compared."""


class InvalidLandmarkModelError(DeepSimbadClientError, code="invalid_landmark_model"):
    """A file or answer that is no landmark model, or one that this version cannot rank by."""


class SourceError(DeepSimbadClientError, code="invalid_source"):
    """A recording that cannot be read as a whole: missing, empty or inconsistent."""


class BrokenFrameError(SourceError, code="broken_frame"):
    """One frame of a recording that cannot be read; it is counted under the words `reason`, as in `left_out`."""

    def __init__(self, message: str, reason: str = "undecodable") -> None:
        super().__init__(message)
        self.reason = reason


class TooManyLeftOutError(SourceError, code="frames_left_out"):
    """More frames of a recording are left out than may be without the caller's word."""


class OtherFramesError(SourceError, code="other_frames"):
    """A recording whose frames differ from those that its traverse holds; `names` are those of differing frames."""

    def __init__(self, message: str, names: Sequence[str]) -> None:
        super().__init__(message)
        self.names = tuple(names)


class ReplayError(DeepSimbadClientError, code="replay"):
    """A replay that cannot go on or be scored."""


class TransportError(DeepSimbadClientError, code="no_answer"):
    """The request was sent as often as allowed and no answer came back."""


class TransportTimeoutError(TransportError, code="timeout"):
    """The service did not answer within the time allowed."""


class UnexpectedAnswerError(DeepSimbadClientError, code="unexpected_answer"):
    """An answer that is not what the contract says: something else answers at this address."""


class DamagedDownloadError(DeepSimbadClientError, code="damaged_download"):
    """A downloaded file with another digest than the service named."""


class NotSavedError(DeepSimbadClientError, code="not_saved"):
    """A file that cannot be written here."""


class NoEarlierMapError(DeepSimbadClientError, code="no_earlier_map"):
    """There is no map to roll back to."""


class JobFailedError(DeepSimbadClientError, code="job_failed"):
    """A job ended without success; `job` is the `Job` as the service last described it."""

    def __init__(self, message: str, job: Any) -> None:
        super().__init__(message)
        self.job = job


class JobCancelledError(JobFailedError, code="cancelled"):
    """A job was cancelled before it ended."""


BY_CODE: "dict[str, type[ApiError]]" = {}
BY_STATUS: "dict[int, type[ApiError]]" = {}


class ApiError(DeepSimbadClientError):
    """The service answered with an error (RFC 9457 problem details).

    `code` is the problem's stable code word (`http_<status>` when the answer held none), `problem` the whole document,
    `request_id` the request's id in the service's log, `retry_after_s` the seconds that the service asks to wait.
    """

    _advice = ""

    def __init_subclass__(cls, code: str = "", status: int = 0, advice: str = "") -> None:
        super().__init_subclass__(code)
        cls._advice = advice or cls._advice
        if code:
            BY_CODE[code] = cls
        if status:
            BY_STATUS[status] = cls

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
        """Words for what the caller can do about the error; "" where there is nothing to add to the message."""
        return self._advice.format_map({"map_version": None, **self.problem})

    def __str__(self) -> str:
        request = f", request {self.request_id}" if self.request_id else ""
        advice = f"; {self.advice}" if self.advice else ""
        return f"{self.message} ({self.status} {self.code}{request}){advice}"


_GIVE = "give it in $DEEPSIMBAD_API_KEY or --api-key"
_MAKE = "`deepsimbad keys create {options}` makes one where the service runs; " + _GIVE


class UnauthorizedError(ApiError, status=401, code="unauthorized", advice=_GIVE):
    """401: no key, or one the service does not know."""


class ForbiddenError(ApiError, status=403, code="forbidden"):
    """403: the key lacks the scope this call needs, or is for other domains."""

    @property
    def advice(self) -> str:
        """How to come by another key, where that is what the service asks for."""
        if domains := self.problem.get("domains"):
            return f"it opens {', '.join(domains)}; " + _MAKE.format(options="--scope localize --domain NAME")
        scope = self.problem.get("needed")
        return _MAKE.format(options=f"--scope {scope}") if scope else ""


class NotFoundError(ApiError, status=404):
    """404: a name or id that nothing answers to."""


class UnknownDomainError(NotFoundError, code="unknown_domain"):
    """No such domain."""


class UnknownTraverseError(NotFoundError, code="unknown_traverse"):
    """No such traverse in the domain."""


class UnknownJobError(NotFoundError, code="unknown_job"):
    """No such job."""


class UnknownSessionError(NotFoundError, code="unknown_session"):
    """No such session, or one that ended long ago."""


class ConflictError(ApiError, status=409):
    """409: the request is sound but the present state forbids it."""


class NoActiveMapError(ConflictError, code="no_active_map"):
    """The domain has no active map yet."""


class DomainDiffersError(ConflictError, code="domain_differs"):
    """A domain of that name exists with another configuration."""


class LandmarkModelDiffersError(
    ConflictError,
    code="landmark_model_differs",
    advice="`client.on_board(domain, map_version={map_version})` fetches it",
):
    """The view was made by another landmark model than the answering map's: fetch the `map_version` of `problem`."""


class FramesDifferError(ConflictError, code="frames_differ"):
    """Frames sent without `replace` differ from the stored ones of their indices."""


class TraverseInUseError(ConflictError, code="traverse_in_use"):
    """A running job still reads the traverse or domain."""


class LostActivationError(ConflictError, code="lost_activation"):
    """The active map was not the expected one when the swap was tried."""


class GoneError(ApiError, status=410):
    """410: a retired map, or an expired or deleted session."""


class EndedSessionError(GoneError, code="ended_session"):
    """The session expired or was deleted: start another."""


class RetiredMapError(GoneError, code="retired_map"):
    """The map that the session began on is no more: start another session on the present one."""


class InvalidInputError(ApiError, status=422):
    """422: a value or body that can never be accepted as it stands."""


class InvalidMoveError(InvalidInputError, code="invalid_move"):
    """A move that is NaN, negative or longer than a robot may report."""


class PastTheEndError(InvalidMoveError, code="past_the_end"):
    """A move that leads past the end of an open route wherever the robot may be."""


class InvalidPriorError(InvalidInputError, code="invalid_prior"):
    """A start or prior far off the route, or without a usable deviation."""


class IdempotencyKeyReusedError(InvalidInputError, code="idempotency_key_reused"):
    """The idempotency key was used before for another request."""


class RateLimitedError(ApiError, status=429, code="rate_limited"):
    """429: too many requests; `retry_after_s` says how long to wait."""


class TooManySessionsError(RateLimitedError, code="too_many_sessions"):
    """The service holds as many live sessions as it may."""


class ServerError(ApiError):
    """5xx: the service failed."""


class UnavailableError(ServerError, status=503):
    """503: the service cannot answer now; its data is safe."""


class DamagedMapError(UnavailableError, code="damaged_map"):
    """A map file on the server fails its digest or cannot be read."""


def api_error_class(status: int, code: str) -> type[ApiError]:
    """The class of an error answer: by its code word, else by its status, else by the hundred of its status."""
    return BY_CODE.get(code) or BY_STATUS.get(status) or (ServerError if status >= 500 else ApiError)
