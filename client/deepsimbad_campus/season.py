"""How one drive looks: leaves, ground and sky by its season and date, and the daylight of its frames."""

import datetime

import cv2
import numpy as np
from numpy.typing import ArrayLike

from deepsimbad_campus.camera import Array, Colour, Image
from deepsimbad_campus.route import stream

# The four recordings the paper uses.
PAPER_DATES = {"winter": "2012-01-22", "spring": "2012-03-31", "summer": "2012-08-04", "autumn": "2012-11-17"}
SHADES = np.arange(256)[None, :, None]  # what a look-up table is made of


class CampusError(ValueError):
    """A campus that cannot be rendered as asked; the message is one sentence."""

    code = "invalid_campus"


def drive_date(season: str) -> datetime.date:
    """The date a season's name or an ISO date stands for; raises CampusError when it is neither."""
    try:
        return datetime.date.fromisoformat(PAPER_DATES.get(season, season))
    except ValueError as cause:
        names = ", ".join(PAPER_DATES)
        raise CampusError(f"season {season!r} is neither one of {names} nor a date like 2012-08-04") from cause


class Season:
    """How a drive on a date looks: its season's values (winter, spring, summer, autumn), varied by that day's own."""

    def __init__(self, date: datetime.date, seed: int) -> None:
        number, rng = date.month % 12 // 3, stream(seed, f"weather {date}")
        self.name = tuple(PAPER_DATES)[number]
        self.sun_azimuth_deg = (215, 140, 185, 243)[number] + rng.uniform(-15, 15)  # clockwise from north
        self.sun_elevation_deg = (17, 38, 62, 13)[number] * rng.uniform(0.9, 1.1)
        self.sun_strength = (0.55, 0.75, 0.9, 0.7)[number]  # direct light on a surface that faces the sun
        self.sun = ((205, 232, 255), (235, 248, 255), (240, 252, 255), (160, 214, 255))[number]  # 255 is neutral
        # Colour and strength of light from the sky; the sky's own colours high up and, as that of haze, low down.
        self.ambient = ((185, 172, 160), (150, 146, 142), (132, 134, 136), (172, 162, 152))[number]
        self.zenith = ((190, 160, 130), (205, 140, 72), (215, 138, 52), (190, 145, 95))[number]
        self.horizon = ((222, 218, 212), (235, 218, 196), (238, 222, 190), (205, 220, 235))[number]
        self.cloud_share = min(0.9, (0.55, 0.35, 0.2, 0.6)[number] * rng.uniform(0.7, 1.4))
        self.leaf_share = (0.0, 0.30, 1.0, 0.42)[number] * rng.uniform(0.85, 1.0)  # how many leaves the trees hold
        self.leaves: tuple[Colour, ...] = (  # colours they are drawn from
            ((70, 90, 110),),
            ((70, 165, 140), (80, 180, 165), (150, 140, 205), (90, 150, 110)),
            ((32, 92, 48), (36, 112, 62), (28, 78, 44), (44, 126, 80)),
            ((20, 110, 190), (30, 150, 215), (28, 70, 165), (40, 120, 140)),
        )[number]
        self.grass = ((62, 92, 104), (50, 122, 98), (46, 128, 92), (48, 112, 112))[number]
        self.snow = (0.85, 0.0, 0.0, 0.0)[number]  # how much of the ground is snow
        self.litter = (0.05, 0.08, 0.0, 0.6)[number]  # how much of the ground fallen leaves cover
        self.wet = (0.5, 0.25, 0.0, 0.4)[number]  # how dark paving is
        self.haze_per_m = (0.0105, 0.0024, 0.0012, 0.0065)[number]  # share of a colour lost in a metre
        self.exposure = (1.0, 1.0, 1.0, 0.92)[number] * rng.uniform(0.92, 1.08)  # overall brightness


class Light:
    """The daylight of one frame: what sun, sky and haze make of a surface's own colour.

    `sunshine` is 0 when a cloud hides the sun, 1 when none does; `exposure` is the camera's gain.
    """

    def __init__(self, season: Season, sunshine: float, exposure: float) -> None:
        self.season, self.sunshine, self.exposure = season, sunshine, exposure
        azimuth, elevation = np.deg2rad(season.sun_azimuth_deg), np.deg2rad(season.sun_elevation_deg)
        flat = np.cos(elevation)
        # [3] unit vector to the sun: north, east, up.
        self.sun = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        self.air = np.array(season.horizon) * exposure  # [3] what haze looks like
        # Light from the sky, which is brighter under cloud, and from the sun.
        self._sky = np.array(season.ambient) / 255 * (1.12 - 0.12 * sunshine) * (season.exposure * exposure)
        self._direct = np.array(season.sun) / 255 * season.sun_strength * sunshine * (season.exposure * exposure)

    def gain(self, towards_sun: float) -> Array:
        """[3] factor on a colour for a surface whose normal has this cosine to the sun; 0 is in shade."""
        return np.asarray(self._sky + max(0.0, towards_sun) * self._direct, np.float64)

    def on_ground(self, share: float) -> Array:
        """[3] factor for the ground, or what stands on it, where so much of it is in the sun."""
        return self.gain(share * self.sun[2])

    def haze(self, distance_m: float) -> float:
        """Share of a colour that haze has taken at a distance, 0..1."""
        return 1.0 - float(np.exp(-self.season.haze_per_m * distance_m))

    def tones(self, colours: ArrayLike, gain: Array, distance_m: float) -> Image:
        """[..., 3] the colours at a distance of surfaces of [..., 3] own colours, or of [..., 1] greys."""
        share = self.haze(distance_m)
        return np.minimum(np.multiply(colours, gain) * (1 - share) + self.air * share, 255).astype(np.uint8)

    def shine_on(self, picture: Image, gain: Array, distance_m: float) -> Image:
        """A picture of a surface's own colours as the camera sees it at a distance."""
        return np.asarray(cv2.LUT(picture, self.tones(SHADES, gain, distance_m)), np.uint8)
