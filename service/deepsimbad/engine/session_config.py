"""What a session is begun with, and which moves and priors its map allows."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Self

from deepsimbad.core.filters import FilterKind
from deepsimbad.core.route import Route
from deepsimbad.core.update_rules import UpdateRule
from deepsimbad.engine.active_localizer import LocalizerConfig
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import InvalidMoveError, InvalidPriorError

DEFAULT_START_STD_M = 5.0
LONGEST_MOVE_ACTIONS = 10.0  # a robot may report a move of up to so many of the domain's longest action
_SLACK_STDS = 3.0  # a prior may lie beyond the route by so many of its deviations
_LARGEST_STD_M = 1e6


@dataclass(frozen=True)
class SessionConfig:
    """How a session begins and goes on; kept with it.

    Attributes:
        start_position_m: Where it begins; None: anywhere on the route.
        start_std_m: How sure that is.
        seed: Of whatever is random in it.
        planner: By name; None: the default.
        belief: The filter.
        update: How a view counts; None: as the map's relevance wants.
    """

    start_position_m: float | None = None
    start_std_m: float = DEFAULT_START_STD_M
    seed: int = 0
    planner: str | None = None
    belief: FilterKind = FilterKind.GRID
    update: UpdateRule | None = None

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Self:
        """What `as_dict` gave."""
        update = stored["update"]
        return cls(
            **{
                **stored,
                "belief": FilterKind(stored["belief"]),
                "update": None if update is None else UpdateRule(update),
            }
        )

    def localizer_config(self) -> LocalizerConfig:
        """The part that the algorithm knows."""
        return LocalizerConfig(filter=self.belief, update=self.update, planner=self.planner, seed=self.seed)


def check_start(route: Route, config: SessionConfig) -> None:
    """Refuse a start that is no belief on the route; raises InvalidPriorError."""
    check_prior(route, config.start_position_m, config.start_std_m)


def check_prior(route: Route, position_m: float | None, std_m: float) -> None:
    """Refuse a prior that is no belief on the route; no position is anywhere on it.

    Raises:
        InvalidPriorError: NaN or infinity, a deviation that is not positive, or a position so far beyond the route
            that the robot would hardly be on it.
    """
    if not (math.isfinite(std_m) and 0 < std_m <= _LARGEST_STD_M):
        raise InvalidPriorError(
            f"a standard deviation of {std_m} m cannot be one: it must be above 0 and at most {_LARGEST_STD_M:g}"
        )
    if position_m is None:
        return
    first_m, last_m = route.start_m, float(route.position_m[-1])
    if route.closed:
        last_m = route.start_m + route.length_m
    slack_m = _SLACK_STDS * std_m
    if not (math.isfinite(position_m) and first_m - slack_m <= position_m <= last_m + slack_m):
        raise InvalidPriorError(
            f"position {position_m} m is off the route, which runs from {first_m:g} m to {last_m:g} m",
            route_start_m=first_m,
            route_end_m=last_m,
        )


def check_move(snapshot: MapSnapshot, action_m: float, action_std_m: float | None) -> None:
    """Refuse a move that no robot of the domain makes.

    Raises:
        InvalidMoveError: Not finite, negative, or longer than ten of the longest action.
    """
    longest_m = LONGEST_MOVE_ACTIONS * float(snapshot.actions_m.max())
    for name, metres in (("action_m", action_m), ("action_std_m", action_std_m)):
        if metres is not None and not (math.isfinite(metres) and 0 <= metres <= longest_m):
            raise InvalidMoveError(
                f"{name} is {metres}: give metres from 0 to {longest_m:g}, ten of the domain's longest action",
                minimum=0.0,
                maximum=longest_m,
            )
