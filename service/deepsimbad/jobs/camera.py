"""What the camera of another domain saw twice there, for a map whose own route it saw in one season."""

from deepsimbad.core.building import SeenTwice, covers
from deepsimbad.core.composed import LEAST_SHARED_PLACES
from deepsimbad.core.drive import Drive
from deepsimbad.core.route import same_places
from deepsimbad.errors import InvalidEncodingError, InvalidMapConfigError, NoActiveMapError, WeightsDifferError
from deepsimbad.jobs.append import seasons_in
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import DomainRecord
from deepsimbad.store.traverses import Traverse


def seen_twice(catalog: Catalog, camera_of: str, domain: DomainRecord, training: Drive) -> tuple[SeenTwice, ...]:
    """Every further season of another domain's active map beside its first, from the drives that it is made of.

    Args:
        camera_of: The other domain.
        domain, training: Whose map is made, and from which drive.

    Raises:
        UnknownDomainError, NoActiveMapError: There is no such domain or map.
        InvalidMapConfigError: It has another evaluator, learnt from no second season, or a drive of it is gone.
        InvalidEncodingError, WeightsDifferError: Its encodings are others.
    """
    other = catalog.domain(camera_of)
    if other.name == domain.name:
        raise InvalidMapConfigError(f"camera_of names domain {camera_of} itself: name one of another route")
    if other.evaluator != domain.evaluator:
        raise InvalidMapConfigError(
            f"domain {camera_of} has another evaluator than {domain.name}: what it learnt says nothing here",
            evaluator=other.evaluator,
        )
    if other.active_version is None:
        raise NoActiveMapError(f"domain {camera_of}, which camera_of names, has no active map", domain=camera_of)
    active = catalog.map(camera_of, other.active_version)
    names = [name or "?" for name, agrees in seasons_in(active.config, active.metrics).items() if agrees]
    its_map = f"map {active.version} of domain {camera_of}"
    if len(names) < 2:
        raise InvalidMapConfigError(f"{its_map} knows no second season: map it from two drives of its route first")
    stored = Traverse.list(catalog.data_dir, camera_of)
    if gone := [name for name in names if name not in stored]:
        raise InvalidMapConfigError(f"{its_map} is made of traverse {gone[0]}, which is gone: map it anew first")
    drives = []
    for name in names:
        with Traverse.open(catalog.data_dir, camera_of, name) as traverse:
            drives.append(traverse.read())
        what = f"traverse {name} of domain {camera_of}"
        if drives[-1].encoding_dim != training.encoding_dim:
            raise InvalidEncodingError(
                f"{what} holds encodings of {drives[-1].encoding_dim} numbers, not of {training.encoding_dim}"
            )
        WeightsDifferError.check(what, drives[-1].weights_sha256, training.name, training.weights_sha256)
    first, *seasons = drives
    route = first.route(other.closed)
    seen = [SeenTwice(first, season, same_places(season.route(), route)) for season in seasons]
    if not any(covers(route.position_m, twice.places[:, 0]) for twice in seen):
        raise InvalidMapConfigError(
            f"{its_map} knows too few places in two seasons: {LEAST_SHARED_PLACES} over half of the route are the least"
        )
    return tuple(seen)
