"""From latitude and longitude to metres: UTM, so that two drives of one place have one plane."""

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.recordings.track import Reals

_RADIUS_M, _FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS 84
_SCALE, _FALSE_EAST_M = 0.9996, 500_000.0
_N = _FLATTENING / (2 - _FLATTENING)
_MERIDIAN_M = _RADIUS_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_ALPHA = (
    _N / 2 - 2 / 3 * _N**2 + 5 / 16 * _N**3,
    13 / 48 * _N**2 - 3 / 5 * _N**3,
    61 / 240 * _N**3,
)  # Krueger's series: better than a millimetre within a zone
GPS_DEADBAND_M = 3.0  # A receiver's fix wanders by so much while it stands


def zone_remarks(latitude: Reals, longitude: Reals) -> list[str]:
    """What is to be said of places [n] in degrees that lie in several zones."""
    longitude = longitude[~_unknown(latitude, longitude)]
    zones = np.unique(np.floor(longitude / 6)) % 60 + 31
    if len(zones) < 2:
        return []
    median = np.floor(np.median(longitude) / 6) % 60 + 31
    numbers = ", ".join(f"{(zone - 1) % 60 + 1:.0f}" for zone in zones)
    return [
        f"it crosses UTM zones ({numbers}): x, y are metres of zone {(median - 1) % 60 + 1:.0f} all along, and another "
        "drive's are comparable only where most of it lies in that zone too"
    ]


def utm(latitude: Reals, longitude: Reals) -> tuple[Reals, Reals]:
    """North and east [n] in metres of places [n] in degrees, all in the zone of their median; NaN stays NaN.

    Places south of the equator have negative norths. 0, 0 is what receivers say that know nothing: it becomes NaN.
    """
    unknown = _unknown(latitude, longitude)
    if unknown.all():
        return np.full(len(latitude), np.nan), np.full(len(latitude), np.nan)
    centre = np.floor(np.median(longitude[~unknown]) / 6) * 6 + 3
    phi, lam = np.radians(np.where(unknown, np.nan, latitude)), np.radians(longitude - centre)
    # Karney, Transverse Mercator with an accuracy of a few nanometers, 2011, equations 7 to 11
    e = 2 * np.sqrt(_N) / (1 + _N)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arctanh(np.sin(lam) / np.hypot(1, t))
    north, east = xi.copy(), eta.copy()
    for order, alpha in enumerate(_ALPHA, start=1):
        north += alpha * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
        east += alpha * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
    return _SCALE * _MERIDIAN_M * north, _FALSE_EAST_M + _SCALE * _MERIDIAN_M * east


def _unknown(latitude: Reals, longitude: Reals) -> NDArray[np.bool_]:
    """Which of places [n] in degrees are none."""
    is_origin = (latitude == 0) & (longitude == 0)
    return np.asarray(is_origin | ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)))
