"""Describing a domain, whatever state its map is in."""

from deepsimbad.api.schemas import DomainAnswer
from deepsimbad.engine.encoders import EvaluatorPool, ready
from deepsimbad.engine.maps import Maps
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import NoActiveMapError, UnavailableError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.records import DomainRecord


def describe_domain(record: DomainRecord, evaluators: EvaluatorPool, maps: Maps) -> DomainAnswer:
    """A domain and its active map; may read files, so it belongs in a thread.

    Raises:
        UnknownDomainError: It was deleted meanwhile.
    """
    evaluator, evaluator_problem = _evaluator(evaluators, record)
    snapshot, problem = _active_map(maps, record)
    return DomainAnswer(
        name=record.name,
        evaluator=record.evaluator,
        evaluator_problem=evaluator_problem,
        input_size=evaluator and evaluator.input_size,
        encoding_dim=evaluator and evaluator.encoding_dim,
        weights_sha256=evaluator and evaluator.weights_sha256,
        closed=record.closed,
        actions_m=list(record.actions_m),
        created_at=record.created_at,
        map_version=snapshot.version if snapshot else record.active_version,
        map_problem=problem,
        relevance=snapshot and snapshot.retrieval.relevance.value,
        route_length_m=snapshot and snapshot.route.length_m,
        n_map_images=snapshot and snapshot.n_images,
        n_landmarks=snapshot and snapshot.n_landmarks,
        list_length=snapshot and snapshot.list_length,
        index_bits_per_map_image=snapshot and snapshot.index_bits_per_map_image,
        landmark_model_digest=snapshot and snapshot.landmark_model_digest,
    )


def _evaluator(evaluators: EvaluatorPool, record: DomainRecord) -> tuple[Evaluator | None, str | None]:
    """The evaluator, or the code of what keeps it from being loaded."""
    try:
        return ready(evaluators.evaluator(record.evaluator)), None
    except UnavailableError as error:
        return None, error.hints.get("reason", error.code)


def _active_map(maps: Maps, record: DomainRecord) -> tuple[MapSnapshot | None, str | None]:
    """The active map, or the code of what is wrong with it; neither where there is none yet."""
    try:
        return maps.active(record.name).snapshot, None
    except NoActiveMapError:
        return None, None
    except UnavailableError as error:  # damaged, or not to be read at this moment
        return None, error.code
