"""How one drive looks: light, sky, leaves and ground, from its season and its date."""

import datetime
from dataclasses import dataclass, replace
from typing import Literal

from deepsimbad_client.campus.noise import stream
from deepsimbad_client.errors import InvalidArgumentError

SeasonName = Literal["winter", "spring", "summer", "autumn"]
Colour = tuple[float, float, float]  # blue, green, red, 0..255

PAPER_DATES: dict[SeasonName, str] = {
    "winter": "2012-01-22",
    "spring": "2012-03-31",
    "summer": "2012-08-04",
    "autumn": "2012-11-17",
}
"""The four recordings the paper uses, by season."""


@dataclass(frozen=True)
class Season:
    """The appearance of one drive.

    Attributes:
        name: Which season.
        sun_azimuth_deg: Where the sun stands, clockwise from north.
        sun_elevation_deg: How high it stands.
        sun_strength: Direct light on a surface that faces the sun; 0 under cloud.
        sun: Colour of direct light, 255 is neutral.
        ambient: Colour and strength of light from the sky.
        zenith: Sky overhead.
        horizon: Sky low down, and the colour of haze.
        cloud_share: How much of the sky is cloud, 0..1.
        leaf_share: How many leaves the trees hold, 0..1.
        leaves: Colours leaves are drawn from.
        grass: Colour of grass.
        snow: How much of the ground is snow, 0..1.
        litter: How much of the ground fallen leaves cover, 0..1.
        wet: How dark and glossy paving is, 0..1.
        haze_per_m: Share of a colour lost to haze in a metre.
        exposure: Overall brightness.
    """

    name: SeasonName
    sun_azimuth_deg: float
    sun_elevation_deg: float
    sun_strength: float
    sun: Colour
    ambient: Colour
    zenith: Colour
    horizon: Colour
    cloud_share: float
    leaf_share: float
    leaves: tuple[Colour, ...]
    grass: Colour
    snow: float
    litter: float
    wet: float
    haze_per_m: float
    exposure: float


_SEASONS: dict[SeasonName, Season] = {
    "winter": Season(
        "winter", 215, 17, 0.55, (205, 232, 255), (185, 172, 160), (190, 160, 130), (222, 218, 212),
        0.55, 0.0, ((70, 90, 110),), (62, 92, 104), 0.85, 0.05, 0.5, 0.0105, 1.0,
    ),
    "spring": Season(
        "spring", 140, 38, 0.75, (235, 248, 255), (150, 146, 142), (205, 140, 72), (235, 218, 196),
        0.35, 0.30, ((70, 165, 140), (80, 180, 165), (150, 140, 205), (90, 150, 110)),
        (50, 122, 98), 0.0, 0.08, 0.25, 0.0024, 1.0,
    ),
    "summer": Season(
        "summer", 185, 62, 0.9, (240, 252, 255), (132, 134, 136), (215, 138, 52), (238, 222, 190),
        0.2, 1.0, ((32, 92, 48), (36, 112, 62), (28, 78, 44), (44, 126, 80)),
        (46, 128, 92), 0.0, 0.0, 0.0, 0.0012, 1.0,
    ),
    "autumn": Season(
        "autumn", 243, 13, 0.7, (160, 214, 255), (172, 162, 152), (190, 145, 95), (205, 220, 235),
        0.6, 0.42, ((20, 110, 190), (30, 150, 215), (28, 70, 165), (40, 120, 140)),
        (48, 112, 112), 0.0, 0.6, 0.4, 0.0065, 0.92,
    ),
}  # fmt: skip


def drive_date(season: str) -> datetime.date:
    """The date a season's name or an ISO date stands for.

    Raises:
        InvalidArgumentError: When it is neither.
    """
    for name, date in PAPER_DATES.items():
        if season == name:
            return datetime.date.fromisoformat(date)
    try:
        return datetime.date.fromisoformat(season)
    except ValueError as cause:
        names = ", ".join(PAPER_DATES)
        raise InvalidArgumentError(f"season {season!r} is neither one of {names} nor a date like 2012-08-04") from cause


def season_of(date: datetime.date, seed: int) -> Season:
    """The appearance of a drive on a date: its season, with that day's own sun, cloud and exposure."""
    names: tuple[SeasonName, ...] = ("winter", "spring", "summer", "autumn")
    base = _SEASONS[names[date.month % 12 // 3]]
    rng = stream(seed, f"weather {date.isoformat()}")
    return replace(
        base,
        sun_azimuth_deg=base.sun_azimuth_deg + float(rng.uniform(-15, 15)),
        sun_elevation_deg=base.sun_elevation_deg * float(rng.uniform(0.9, 1.1)),
        cloud_share=min(0.9, base.cloud_share * float(rng.uniform(0.7, 1.4))),
        leaf_share=base.leaf_share * float(rng.uniform(0.85, 1.0)),
        exposure=base.exposure * float(rng.uniform(0.92, 1.08)),
    )
