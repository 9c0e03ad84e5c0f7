"""Small recordings written the way the real ones lie on disk, without any of the readers' code."""

import cv2
import numpy as np
import pytest


def pixels_of(encoded):
    """What an image that is sent shows, [height, width, 3] uint8, BGR."""
    return cv2.imdecode(np.frombuffer(encoded.body, np.uint8), cv2.IMREAD_COLOR)


def empty_files(folder, names):
    for name in names:
        (folder / name).write_bytes(b"")


class NcltTree:
    """Writes one date of NCLT under `root`."""

    date = "2012-01-22"
    start_us = 1_326_030_975_726_043

    def __init__(self, root):
        self.root = root

    @property
    def source(self):
        return f"nclt:{self.root}/{self.date}"

    @staticmethod
    def tiff(stored):
        """A TIFF with JPEG inside, like NCLT's; OpenCV makes one only with strips of a multiple of 8 rows."""
        flags = [cv2.IMWRITE_TIFF_COMPRESSION, 7, cv2.IMWRITE_TIFF_ROWSPERSTRIP, 16]
        ok, body = cv2.imencode(".tiff", stored, flags)
        assert ok
        return body.tobytes()

    @staticmethod
    def picture(width=64, height=48):
        """A picture on its side; upright it is blue above, green at the lower left, red at the lower right."""
        upright = np.zeros((width, height, 3), np.uint8)
        upright[: width // 2] = (250, 30, 30)
        upright[width // 2 :, : height // 2] = (30, 250, 30)
        upright[width // 2 :, height // 2 :] = (30, 30, 250)
        return cv2.rotate(upright, cv2.ROTATE_90_COUNTERCLOCKWISE)

    def image_file(self, utime, body=None, camera=5, above=""):
        folder = self.root / above / self.date / "lb3" / f"Cam{camera}"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{utime}.tiff"
        path.write_bytes(self.tiff(self.picture()) if body is None else body)
        return path

    def truth(self, lines, place=None):
        path = self.root / (place or f"ground_truth/groundtruth_{self.date}.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{line}\n" for line in lines))
        return path

    @staticmethod
    def row(utime, x, y, yaw=0.0):
        return f"{utime},{x:.9f},{y:.9f},-0.5,0.01,0.02,{yaw:.9f}"

    def walk_north(self, seconds):
        """Ground truth of a robot that goes north at 1 m/s, 100 rows a second."""
        return [self.row(self.start_us + 10_000 * i, i / 100, 3.0) for i in range(round(seconds * 100) + 1)]


@pytest.fixture
def nclt_tree(tmp_path):
    return NcltTree(tmp_path / "nclt")
