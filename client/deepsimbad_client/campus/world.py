"""The campus of one seed: a route and what stands along it, the same in every season."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.noise import stream
from deepsimbad_client.campus.plot import NEIGHBOURS, Plot, _Footprint
from deepsimbad_client.campus.route import Route, Stretch
from deepsimbad_client.campus.scenery import Scene
from deepsimbad_client.campus.zones import DECK, Zone, furnish

SIGHT_M = 130.0
"""Nothing farther along the route than this is drawn."""

BEHIND_M = 25.0


@dataclass(frozen=True)
class Section:
    """A stretch with its zone and scenery."""

    stretch: Stretch
    zone: Zone
    scene: Scene


class World:
    """Everything that stays where it is; made whole at once, a few hundred bytes per metre.

    Args:
        seed: Equal seeds make equal worlds.
        length_m: Length of the route to furnish; the beginning of a longer world is the shorter world.
    """

    def __init__(self, seed: int, length_m: float) -> None:
        self.seed = seed
        # A stretch is furnished knowing the route well beyond it, so the route goes on past the last of them.
        self.route = Route(seed, length_m + 2 * SIGHT_M + 400)
        self.sections: list[Section] = []
        footprints: list[_Footprint] = []
        for stretch in self.route.stretches:
            if stretch.start_m > length_m + SIGHT_M:
                break
            deck = stream(seed, "deck", stretch.index // len(DECK)).permutation(len(DECK))
            zone = DECK[int(deck[stretch.index % len(DECK)])]
            plot = Plot(self.route, stretch, stream(seed, "stretch", stretch.index), footprints)
            furnish(plot, zone)
            self.sections.append(Section(stretch, zone, plot.scene))
            del footprints[:-NEIGHBOURS]
        self._starts = np.array([section.stretch.start_m for section in self.sections])

    def ahead(self, position_m: float) -> list[Section]:
        """The sections that may be seen from a route position, nearest first."""
        return self.sections[self._index(position_m - BEHIND_M) : self._index(position_m + SIGHT_M) + 1]

    def skyline(self) -> NDArray[np.float64]:
        """[360] elevation in degrees of the far hills and woods, by azimuth in degrees."""
        rng = stream(self.seed, "skyline")
        angles = np.deg2rad(np.arange(360.0))
        height = np.full(360, 2.6)
        for waves in range(2, 40):
            phase, amplitude = rng.uniform(0, 2 * np.pi), rng.normal() * 1.6 / waves**0.7
            height += amplitude * np.sin(waves * angles + phase)
        return np.asarray(np.clip(height, 0.6, 8), np.float64)

    def _index(self, position_m: float) -> int:
        return int(np.clip(np.searchsorted(self._starts, position_m, "right") - 1, 0, len(self._starts) - 1))
