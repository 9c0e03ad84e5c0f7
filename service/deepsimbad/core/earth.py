"""Where on Earth a place of the plane lies, by an anchor of its origin (WGS 84)."""

import math

_EQUATOR_M, _FLATTENING = 6_378_137.0, 1 / 298.257_223_563


def on_earth(
    x_m: float, y_m: float, lat_deg: float, lon_deg: float, bearing_deg: float, height_m: float
) -> tuple[float, float]:
    """(latitude, longitude) in degrees of a place, by the meridian and the parallel through the anchor.

    Args:
        lat_deg, lon_deg, height_m: Of the origin; metres above the ellipsoid.
        bearing_deg: Of the axis y, clockwise from north.
    """
    turned = math.radians(bearing_deg)
    east_m = x_m * math.cos(turned) + y_m * math.sin(turned)
    north_m = y_m * math.cos(turned) - x_m * math.sin(turned)
    latitude = math.radians(lat_deg)
    eccentricity = _FLATTENING * (2 - _FLATTENING)
    bulge = 1 - eccentricity * math.sin(latitude) ** 2
    meridian_m = _EQUATOR_M * (1 - eccentricity) / bulge**1.5 + height_m
    parallel_m = (_EQUATOR_M / math.sqrt(bulge) + height_m) * math.cos(latitude)
    longitude = lon_deg + math.degrees(east_m / max(parallel_m, 1e-6))
    return lat_deg + math.degrees(north_m / meridian_m), (longitude + 180) % 360 - 180
