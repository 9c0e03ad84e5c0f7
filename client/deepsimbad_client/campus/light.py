"""Daylight of one moment: what sun, sky and haze make of a surface's own colour."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.season import Season

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Light:
    """The light of one frame.

    Args:
        season: The drive's season.
        sunshine: 0 when a cloud hides the sun, 1 when none does.
        exposure: The camera's gain for this frame.
    """

    season: Season
    sunshine: float
    exposure: float

    @cached_property
    def sun_direction(self) -> tuple[float, float, float]:
        """Unit vector towards the sun: north, east, up."""
        azimuth = np.deg2rad(self.season.sun_azimuth_deg)
        elevation = np.deg2rad(self.season.sun_elevation_deg)
        flat = float(np.cos(elevation))
        return flat * float(np.cos(azimuth)), flat * float(np.sin(azimuth)), float(np.sin(elevation))

    def gain(self, towards_sun: float) -> NDArray[np.float64]:
        """[3] factor on a colour for a surface whose normal has this cosine to the sun; 0 is in shade."""
        season = self.season
        direct = season.sun_strength * self.sunshine * max(0.0, towards_sun)
        # Under cloud the sky itself is brighter.
        sky = np.array(season.ambient) / 255 * (1.12 - 0.12 * self.sunshine)
        gain: NDArray[np.float64] = (sky + direct * np.array(season.sun) / 255) * (season.exposure * self.exposure)
        return gain

    def facing(self, north: float, east: float) -> NDArray[np.float64]:
        """[3] factor for an upright wall whose outward normal points north, east."""
        sun = self.sun_direction
        return self.gain(north * sun[0] + east * sun[1])

    @cached_property
    def on_ground(self) -> NDArray[np.float64]:
        """[3] factor for level ground in the open."""
        return self.gain(self.sun_direction[2])

    @cached_property
    def in_shade(self) -> NDArray[np.float64]:
        """[3] factor for ground that the sun does not reach."""
        return self.gain(0.0)

    def haze(self, distance_m: float) -> float:
        """Share of a colour that haze has taken at a distance, 0..1."""
        return 1.0 - float(np.exp(-self.season.haze_per_m * distance_m))

    def colour(self, colour: tuple[float, ...], gain: NDArray[np.float64], distance_m: float) -> tuple[int, ...]:
        """A surface's colour as the camera sees it at a distance."""
        share = self.haze(distance_m)
        seen = np.array(colour) * gain * (1 - share) + self.air * share
        return tuple(int(value) for value in np.clip(seen, 0, 255))

    @cached_property
    def air(self) -> NDArray[np.float64]:
        """[3] what haze looks like."""
        air: NDArray[np.float64] = np.array(self.season.horizon) * self.exposure
        return air

    def shine_on(self, picture: Image, gain: NDArray[np.float64], distance_m: float) -> Image:
        """A picture of a surface's own colours as the camera sees it at a distance."""
        share = self.haze(distance_m)
        levels = np.arange(256)[:, None] * gain * (1 - share) + self.air * share
        table = np.clip(levels, 0, 255).astype(np.uint8)[None]
        return np.asarray(cv2.LUT(picture, table), np.uint8)
