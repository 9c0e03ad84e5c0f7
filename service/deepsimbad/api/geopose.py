"""A place on the route as a GeoPose (OGC 21-056r11, Basic-YPR): where on Earth, and which way."""

import math
from typing import Annotated

from fastapi import Request
from pydantic import Field
from typing_extensions import TypedDict

from deepsimbad.api.requests import JsonBody, prefers
from deepsimbad.core.map import Map
from deepsimbad.core.route import on_earth
from deepsimbad.errors import NotAcceptableError

GEOPOSE = "application/geopose+json"

Degrees = Annotated[float, Field(strict=True, allow_inf_nan=False)]


class AnchorBody(JsonBody):
    """Where the origin of x and y lies on Earth, and how they are turned."""

    lat_deg: Annotated[Degrees, Field(ge=-90, le=90)]
    lon_deg: Annotated[Degrees, Field(ge=-180, le=180)]
    bearing_deg: Annotated[Degrees, Field(ge=0, lt=360, description="Of the axis y, clockwise from north.")] = 0.0
    height_m: Annotated[float, Field(strict=True, allow_inf_nan=False, description="Above the ellipsoid.")] = 0.0


class Position(TypedDict):
    """Degrees, and metres above the ellipsoid."""

    lat: float
    lon: float
    h: float


class Angles(TypedDict):
    """Degrees; yaw from east towards north."""

    yaw: float
    pitch: float
    roll: float


class GeoPoseAnswer(TypedDict):
    """The likeliest place, with the direction of the route there."""

    position: Position
    angles: Angles


def wants_geopose(request: Request) -> bool:
    """Whether `Accept` asks for a GeoPose rather than for JSON."""
    return prefers(request, GEOPOSE)


def render_geopose(snapshot: Map, anchor: AnchorBody | None, image: int) -> GeoPoseAnswer:
    """The pose of a map image.

    Raises:
        NotAcceptableError: The domain has no anchor, or nobody knows where that image was taken, or which way.
    """
    if anchor is None:
        raise NotAcceptableError(
            f"domain {snapshot.domain} has no anchor: PUT it with anchor {{lat_deg, lon_deg, bearing_deg}} first",
            reason="no_anchor",
        )
    route = snapshot.route
    heading = float(route.heading_rad[image])
    if route.x_m is None or route.y_m is None or not math.isfinite(heading):
        raise NotAcceptableError(
            f"map {snapshot.version} of domain {snapshot.domain} knows no x and y there: map a traverse that has them",
            reason="no_heading",
        )
    latitude, longitude = on_earth(float(route.x_m[image]), float(route.y_m[image]), **anchor.model_dump())
    bearing_rad = math.radians(anchor.bearing_deg)
    return {
        "position": {"lat": latitude, "lon": longitude, "h": anchor.height_m},
        "angles": {"yaw": (math.degrees(heading - bearing_rad) + 180) % 360 - 180, "pitch": 0.0, "roll": 0.0},
    }
