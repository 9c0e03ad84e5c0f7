"""How one drive looks: leaves, ground and sky by its season and date, and the daylight of its frames."""

import datetime
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_campus.camera import Array, Colour, Image, ink
from deepsimbad_campus.route import stream

# The four recordings the paper uses.
PAPER_DATES = {"winter": "2012-01-22", "spring": "2012-03-31", "summer": "2012-08-04", "autumn": "2012-11-17"}


class CampusError(ValueError):
    """A campus that cannot be rendered as asked; the message is one sentence."""

    code = "invalid_campus"


class Season(NamedTuple):
    """The appearance of one drive."""

    name: str
    sun_azimuth_deg: float  # clockwise from north
    sun_elevation_deg: float
    sun_strength: float  # direct light on a surface that faces the sun
    sun: Colour  # of direct light, 255 is neutral
    ambient: Colour  # colour and strength of light from the sky
    zenith: Colour
    horizon: Colour  # sky low down, and haze
    cloud_share: float
    leaf_share: float  # how many leaves the trees hold
    leaves: tuple[Colour, ...]  # colours they are drawn from
    grass: Colour
    snow: float  # how much of the ground is snow
    litter: float  # how much of the ground fallen leaves cover
    wet: float  # how dark paving is
    haze_per_m: float  # share of a colour lost in a metre
    exposure: float  # overall brightness


SEASONS = (
    Season(
        "winter", 215, 17, 0.55, (205, 232, 255), (185, 172, 160), (190, 160, 130), (222, 218, 212), 0.55, 0.0,
        ((70, 90, 110),), (62, 92, 104), 0.85, 0.05, 0.5, 0.0105, 1.0,
    ),
    Season(
        "spring", 140, 38, 0.75, (235, 248, 255), (150, 146, 142), (205, 140, 72), (235, 218, 196), 0.35, 0.30,
        ((70, 165, 140), (80, 180, 165), (150, 140, 205), (90, 150, 110)), (50, 122, 98), 0.0, 0.08, 0.25, 0.0024, 1.0,
    ),
    Season(
        "summer", 185, 62, 0.9, (240, 252, 255), (132, 134, 136), (215, 138, 52), (238, 222, 190), 0.2, 1.0,
        ((32, 92, 48), (36, 112, 62), (28, 78, 44), (44, 126, 80)), (46, 128, 92), 0.0, 0.0, 0.0, 0.0012, 1.0,
    ),
    Season(
        "autumn", 243, 13, 0.7, (160, 214, 255), (172, 162, 152), (190, 145, 95), (205, 220, 235), 0.6, 0.42,
        ((20, 110, 190), (30, 150, 215), (28, 70, 165), (40, 120, 140)), (48, 112, 112), 0.0, 0.6, 0.4, 0.0065, 0.92,
    ),
)  # fmt: skip


def drive_date(season: str) -> datetime.date:
    """The date a season's name or an ISO date stands for; raises CampusError when it is neither."""
    try:
        return datetime.date.fromisoformat(PAPER_DATES.get(season, season))
    except ValueError as cause:
        names = ", ".join(PAPER_DATES)
        raise CampusError(f"season {season!r} is neither one of {names} nor a date like 2012-08-04") from cause


def season_of(date: datetime.date, seed: int) -> Season:
    """The appearance of a drive on a date: its season, with that day's own sun, cloud and exposure."""
    season, rng = SEASONS[date.month % 12 // 3], stream(seed, f"weather {date}")
    return season._replace(
        sun_azimuth_deg=season.sun_azimuth_deg + rng.uniform(-15, 15),
        sun_elevation_deg=season.sun_elevation_deg * rng.uniform(0.9, 1.1),
        cloud_share=min(0.9, season.cloud_share * rng.uniform(0.7, 1.4)),
        leaf_share=season.leaf_share * rng.uniform(0.85, 1.0),
        exposure=season.exposure * rng.uniform(0.92, 1.08),
    )


class Light:
    """The daylight of one frame: what sun, sky and haze make of a surface's own colour.

    `sunshine` is 0 when a cloud hides the sun, 1 when none does; `exposure` is the camera's gain.
    """

    def __init__(self, season: Season, sunshine: float, exposure: float) -> None:
        self.season, self.sunshine, self.exposure = season, sunshine, exposure
        azimuth, elevation = np.deg2rad(season.sun_azimuth_deg), np.deg2rad(season.sun_elevation_deg)
        flat = np.cos(elevation)
        self.sun = (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation))  # unit vector: north, east, up
        self.on_ground, self.in_shade = self.gain(self.sun[2]), self.gain(0.0)
        self.air = np.array(season.horizon) * exposure  # [3] what haze looks like

    def gain(self, towards_sun: float) -> Array:
        """[3] factor on a colour for a surface whose normal has this cosine to the sun; 0 is in shade."""
        season = self.season
        direct = season.sun_strength * self.sunshine * max(0.0, towards_sun)
        sky = np.array(season.ambient) / 255 * (1.12 - 0.12 * self.sunshine)  # under cloud the sky itself is brighter
        return np.asarray((sky + direct * np.array(season.sun) / 255) * (season.exposure * self.exposure), np.float64)

    def between(self, share: float) -> Array:
        """[3] factor for what is partly in the sun."""
        return np.asarray(self.in_shade + share * (self.on_ground - self.in_shade), np.float64)

    def haze(self, distance_m: float) -> float:
        """Share of a colour that haze has taken at a distance, 0..1."""
        return 1.0 - float(np.exp(-self.season.haze_per_m * distance_m))

    def colour(self, colour: Colour, gain: Array, distance_m: float) -> tuple[int, ...]:
        """A surface's colour as the camera sees it at a distance."""
        return ink(self._apparent_colour(np.array(colour), gain, distance_m))

    def shine_on(self, picture: Image, gain: Array, distance_m: float) -> Image:
        """A picture of a surface's own colours as the camera sees it at a distance."""
        table = np.clip(self._apparent_colour(np.arange(256)[:, None], gain, distance_m), 0, 255)
        return np.asarray(cv2.LUT(picture, table.astype(np.uint8)[None]), np.uint8)

    def _apparent_colour(self, colour: NDArray[Any], gain: Array, distance_m: float) -> Array:
        share = self.haze(distance_m)
        return np.asarray(colour * gain * (1 - share) + self.air * share, np.float64)
