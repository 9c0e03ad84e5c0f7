"""The sky: its colours, clouds that drift, the far skyline, and what a low sun does to the camera."""

import cv2
import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.campus.camera import CANVAS_SIZE, CENTRE_X, FOCAL_PX, HORIZON_Y, View
from deepsimbad_client.campus.light import Light
from deepsimbad_client.campus.noise import stream, tile_noise
from deepsimbad_client.campus.season import Season

Image = NDArray[np.uint8]

PIXELS_PER_DEG = 4
TOP_DEG = 68
GLARE_PX = 420
DRIFT_DEG_PER_FRAME = 0.06


class Sky:
    """The sky of one drive.

    Args:
        season: Its season.
        drive: A name of the drive; its clouds are its own.
        seed: Seed of the campus.
        skyline_deg: [360] elevation of the far skyline by azimuth in degrees.
    """

    def __init__(self, season: Season, drive: str, seed: int, skyline_deg: NDArray[np.float64]) -> None:
        rng = stream(seed, f"sky {drive}")
        self._season = season
        self._skyline = np.concatenate([skyline_deg, skyline_deg[:1]])
        self._dome = self._paint_dome(season, rng)
        width, rows = CANVAS_SIZE[0], int(np.ceil(HORIZON_Y)) + 1
        x = (np.arange(width) - CENTRE_X)[None, :] / FOCAL_PX
        y = (HORIZON_Y - np.arange(rows))[:, None] / FOCAL_PX
        self._azimuth = np.rad2deg(np.arctan(x)) + np.zeros_like(y)
        elevation = np.rad2deg(np.arctan2(y, np.sqrt(1 + x * x)))
        self._row = np.clip((TOP_DEG - elevation) * PIXELS_PER_DEG, 0, self._dome.shape[0] - 1).astype(np.float32)
        self._column_deg = self._azimuth[0]
        radius = np.hypot(*np.mgrid[-GLARE_PX:GLARE_PX, -GLARE_PX:GLARE_PX]) / GLARE_PX
        self._glare = np.clip(1 - radius, 0, 1)[:, :, None] ** 3.0 * np.array(season.sun)

    def paint(self, canvas: Image, view: View, light: Light, frame: int) -> None:
        """Fill the upper part of the canvas."""
        heading = float(np.rad2deg(view.heading_rad))
        shift = (heading + DRIFT_DEG_PER_FRAME * frame) % 360
        columns = ((self._azimuth + shift) * PIXELS_PER_DEG).astype(np.float32)
        sky = cv2.remap(self._dome, columns, self._row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        gain = light.exposure * (0.86 + 0.14 * light.sunshine)
        canvas[: sky.shape[0]] = cv2.convertScaleAbs(sky, alpha=gain)
        self._paint_skyline(canvas, heading, light)

    def sun_pixel(self, view: View) -> tuple[int, int] | None:
        """Where the sun stands on the canvas; None when it is behind or far outside."""
        turn = np.deg2rad(self._season.sun_azimuth_deg) - view.heading_rad
        turn = float((turn + np.pi) % (2 * np.pi) - np.pi)
        if abs(turn) > 1.05:
            return None
        x = CENTRE_X + FOCAL_PX * np.tan(turn)
        y = HORIZON_Y - FOCAL_PX * np.tan(np.deg2rad(self._season.sun_elevation_deg)) / np.cos(turn)
        return int(x), int(y)

    def glow(self, canvas: Image, sun: tuple[int, int], strength: float) -> None:
        """Add the sun's glow to a canvas, around a pixel that may lie outside of it."""
        height, width = canvas.shape[:2]
        x0, y0 = sun[0] - GLARE_PX, sun[1] - GLARE_PX
        left, top = max(0, x0), max(0, y0)
        right, bottom = min(width, x0 + 2 * GLARE_PX), min(height, y0 + 2 * GLARE_PX)
        if left >= right or top >= bottom:
            return
        part = self._glare[top - y0 : bottom - y0, left - x0 : right - x0]
        added = np.clip(part * strength, 0, 255).astype(np.uint8)
        roi = canvas[top:bottom, left:right]
        cv2.add(roi, added, dst=roi)

    def smear(self, canvas: Image, sun: tuple[int, int]) -> None:
        """Draw the bright line a sensor of this kind bleeds along its columns, which lie level when upright."""
        if 0 <= sun[1] < canvas.shape[0]:
            rows = canvas[max(0, sun[1] - 1) : sun[1] + 2]
            cv2.add(rows, np.full_like(rows, 110), dst=rows)

    def _paint_skyline(self, canvas: Image, heading: float, light: Light) -> None:
        angles = (self._column_deg + heading) % 360
        season = self._season
        woods = np.array(season.leaves[0]) * 0.5 + np.array(season.grass) * 0.2 + 30 * season.snow
        for lift, share in ((1.0, 0.62), (0.55, 0.38)):
            height = np.interp((angles * (2 - lift)) % 360, np.arange(361), self._skyline) * lift
            rise = FOCAL_PX * np.tan(np.deg2rad(height)) / np.cos(np.deg2rad(self._column_deg))
            top = np.stack([np.arange(len(angles)), HORIZON_Y - rise], axis=1)
            outline = np.concatenate([top, [[len(angles) - 1, HORIZON_Y + 3], [0, HORIZON_Y + 3]]])
            ink = woods * light.in_shade * (1 - share) + light.air * share
            colour = tuple(int(v) for v in np.clip(ink, 0, 255))
            cv2.fillPoly(canvas, [np.round(outline).astype(np.int32)], colour)

    @staticmethod
    def _paint_dome(season: Season, rng: np.random.Generator) -> Image:
        height, width = TOP_DEG * PIXELS_PER_DEG, 360 * PIXELS_PER_DEG
        climb = np.linspace(1, 0, height, dtype=np.float32)[:, None, None] ** 0.7
        dome = np.array(season.zenith) * climb + np.array(season.horizon) * (1 - climb)
        dome = np.broadcast_to(dome, (height, width, 3))
        noise = tile_noise(rng, (height, width), (3, 9), 6)
        # Clouds flatten and crowd together low in the sky.
        bar = float(np.quantile(noise, 1 - season.cloud_share))
        opacity = np.clip((noise - bar) / 0.9, 0, 1)[:, :, None]
        tone = np.clip(1.0 - 0.14 * np.roll(noise, -6, axis=0), 0.62, 1.02)[:, :, None]
        white = np.array([246.0, 246, 246]) * tone * (1 - 0.12 * (season.name in ("winter", "autumn")))
        return np.asarray(np.clip(dome * (1 - opacity) + white * opacity, 0, 255), np.uint8)
