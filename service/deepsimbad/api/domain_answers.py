"""Describing a domain, whatever state its map is in."""

from deepsimbad.api.schemas import DomainAnswer
from deepsimbad.engine.active_maps import ActiveMaps
from deepsimbad.engine.evaluator_pool import EvaluatorPool
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import NoActiveMapError, UnavailableError
from deepsimbad.store.records import DomainRecord


def describe_domain(record: DomainRecord, evaluators: EvaluatorPool, active_maps: ActiveMaps) -> DomainAnswer:
    """A domain and its active map; may read files, so it belongs in a thread.

    Raises:
        UnknownDomainError: It was deleted meanwhile.
    """
    evaluator = evaluators.evaluator(record.evaluator)
    snapshot, problem = _active_map(active_maps, record)
    return DomainAnswer(
        name=record.name,
        evaluator=record.evaluator,
        input_size=evaluator.input_size,
        encoding_dim=evaluator.encoding_dim,
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
    )


def _active_map(active_maps: ActiveMaps, record: DomainRecord) -> tuple[MapSnapshot | None, str | None]:
    """The active map, or the code of what is wrong with it; neither where there is none yet."""
    try:
        return active_maps.snapshot(record.name), None
    except NoActiveMapError:
        return None, None
    except UnavailableError as error:  # damaged, or not to be read at this moment
        return None, error.code
