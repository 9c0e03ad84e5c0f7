"""GPX and NMEA files as tracks of a receiver, and an image's place and time by its EXIF.

UTM takes latitude and longitude to metres, so that two drives of one place have one plane.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError, iterparse

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pictures

from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings.track import Reals, Track, track_of

TRACK_SUFFIXES = (".gpx", ".nmea")
_GPS, _EXIF = 0x8825, 0x8769  # EXIF's folders; below them their tags
_LATITUDE, _LONGITUDE, _GPS_TIME, _GPS_DATE = (1, 2), (3, 4), 7, 29
_DATE_TAKEN, _SUBSECOND, _ZONE = 36867, 37521, 36881

_SIDES = {"N": 1, "E": 1, "S": -1, "W": -1}

_Fix = tuple[int, float, float]  # microseconds, degrees north, degrees east


def read_track(path: Path) -> Track:
    """Read a GPX or NMEA file; raises SourceError (it is neither, or fewer than two of its fixes can be used)."""
    try:
        rows = list(_gpx(path) if path.suffix.lower() == ".gpx" else _nmea(path))
    except (OSError, ParseError, ValueError) as error:
        raise SourceError(f"{path} cannot be read as a track: {error}") from error
    fixes = [fix for fix in rows if fix is not None]
    time_us = np.array([fix[0] for fix in fixes], np.int64)
    degrees = np.array([fix[1:] for fix in fixes], np.float64).reshape(-1, 2)
    track = track_of(time_us, *utm(degrees[:, 0], degrees[:, 1]), deadband_m=GPS_DEADBAND_M)
    if track is None:
        rows_name = "track points" if path.suffix.lower() == ".gpx" else "RMC sentences, which alone say the date,"
        raise SourceError(
            f"{path}: of its {len(rows)} {rows_name} fewer than two hold a time and a place that can be used"
        )
    n_skipped_rows = track.n_skipped_rows + len(rows) - len(fixes)
    return replace(track, n_skipped_rows=n_skipped_rows, remarks=zone_remarks(degrees[:, 0], degrees[:, 1]))


def _gpx(path: Path) -> Iterator[_Fix | None]:
    """Yield a GPX file's track points, of any version; None for one without a readable time and place."""
    with path.open("rb") as file:
        for _, point in iterparse(file):  # noqa: S314 - expat itself stops entities that grow
            if point.tag.rpartition("}")[2] == "trkpt":
                yield _gpx_fix(point)
                point.clear()


def _gpx_fix(point: Any) -> _Fix | None:
    times = [part.text or "" for part in point if part.tag.rpartition("}")[2] == "time"]
    with suppress(ValueError, KeyError, IndexError):
        time = datetime.fromisoformat(times[0].strip())
        return _microseconds(time), float(point.attrib["lat"]), float(point.attrib["lon"])
    return None


def _nmea(path: Path) -> Iterator[_Fix | None]:
    """Yield the fixes of RMC sentences, which alone state the date; None for one without a fix, or damaged."""
    for line in path.read_text(encoding="ascii", errors="replace").splitlines():
        sentence, _, checksum = line.strip().rpartition("$")[2].partition("*")
        cells = sentence.split(",")
        if cells[0].endswith("RMC"):
            yield _nmea_fix(sentence, cells, checksum)


def _nmea_fix(sentence: str, cells: list[str], checksum: str) -> _Fix | None:
    if len(cells) < 10 or cells[2] != "A":
        return None
    with suppress(ValueError, KeyError):
        if checksum and int(checksum[:2], 16) != reduce(xor, sentence.encode(), 0):
            return None
        second = datetime.strptime(f"{cells[9]} {cells[1][:6]}", "%d%m%y %H%M%S").replace(tzinfo=UTC)
        fraction = timedelta(seconds=float(f"0{cells[1][6:]}"))
        return _microseconds(second + fraction), _angle(*cells[3:5]), _angle(*cells[5:7])
    return None


def _angle(text: str, side: str) -> float:
    """Degrees from the text DDDMM.MMMM and the side N, S, E or W."""
    degrees, minutes = divmod(float(text), 100)
    return (degrees + minutes / 60) * _SIDES[side]


def _microseconds(time: datetime) -> int:
    time = time if time.tzinfo else time.replace(tzinfo=UTC)
    return (time - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)


@dataclass(frozen=True)
class ExifFix:
    """An image's place and time by its EXIF; NaN or None where it states none."""

    latitude: float = math.nan
    longitude: float = math.nan
    time_us: int | None = None
    in_zone: bool = False  # the time says its zone, or is the receiver's; else it is read as UTC


def read_exif(path: Path) -> ExifFix:
    """The place and time where an image was taken, by its EXIF."""
    try:
        with Pictures.open(path) as picture:
            exif = picture.getexif()
            gps, details = exif.get_ifd(_GPS), exif.get_ifd(_EXIF)
    except (OSError, ValueError, SyntaxError, Pictures.DecompressionBombError):
        return ExifFix()
    latitude, longitude = _exif_degrees(gps, *_LATITUDE), _exif_degrees(gps, *_LONGITUDE)
    with suppress(KeyError, ValueError, TypeError, ZeroDivisionError):
        hours, minutes, seconds = (float(part) for part in gps[_GPS_TIME])
        day = datetime.strptime(gps[_GPS_DATE], "%Y:%m:%d").replace(tzinfo=UTC)
        time_of_day = timedelta(hours=hours, minutes=minutes, seconds=seconds)
        return ExifFix(latitude, longitude, _microseconds(day + time_of_day), in_zone=True)
    with suppress(KeyError, ValueError, TypeError):
        date = datetime.strptime(details[_DATE_TAKEN], "%Y:%m:%d %H:%M:%S")
        zone = str(details.get(_ZONE, ""))
        subsecond = float(f"0.{str(details.get(_SUBSECOND, 0)).strip()}")
        time = datetime.fromisoformat(f"{date.isoformat()}{zone}") + timedelta(seconds=subsecond)
        return ExifFix(latitude, longitude, _microseconds(time), in_zone=bool(zone))
    return ExifFix(latitude, longitude)


def _exif_degrees(gps: dict[int, Any], side: int, angle: int) -> float:
    with suppress(KeyError, ValueError, TypeError, ZeroDivisionError):
        parts = gps[angle] if isinstance(gps[angle], tuple) else (gps[angle],)  # minutes and seconds may lack
        degrees: float = sum(float(part) / 60**place for place, part in enumerate(parts))
        return degrees * _SIDES[str(gps[side]).strip(" \0").upper()[:1]]
    return math.nan


_RADIUS_M, _FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS 84
_SCALE, _FALSE_EAST_M = 0.9996, 500_000.0
_N = _FLATTENING / (2 - _FLATTENING)
_MERIDIAN_M = _RADIUS_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_ALPHA = (
    _N / 2 - 2 / 3 * _N**2 + 5 / 16 * _N**3,
    13 / 48 * _N**2 - 3 / 5 * _N**3,
    61 / 240 * _N**3,
)  # Krueger's series: better than a millimetre within a zone
GPS_DEADBAND_M = 3.0  # by which the fixes of a standing receiver wander


def zone_remarks(latitude: Reals, longitude: Reals) -> list[str]:
    """A remark where places [n] in degrees lie in several UTM zones; empty where they lie in one."""
    longitude = longitude[~_is_unknown(latitude, longitude)]
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

    Places south of the equator have negative norths. Receivers without a fix state 0, 0: it becomes NaN.
    """
    unknown = _is_unknown(latitude, longitude)
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


def _is_unknown(latitude: Reals, longitude: Reals) -> NDArray[np.bool_]:
    """[n] whether each of places [n] in degrees is unknown."""
    is_origin = (latitude == 0) & (longitude == 0)
    return np.asarray(is_origin | ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)))
