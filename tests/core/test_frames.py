import pytest

from deepsimbad.core.frames import Camera

NCLT = Camera(1232, 1616, "Cam5")


@pytest.mark.parametrize(
    ("camera", "cameras", "says"),
    [
        (Camera(616, 808), [NCLT], None),
        (Camera(616, 800), [NCLT], None),
        (Camera(616, 808, "Cam5"), [NCLT], None),
        (Camera(1616, 1232), [], None),
        (Camera(1616, 1232), [NCLT, Camera(4, 3)], None),
        (Camera(1232, 1616, "Cam1"), [Camera(1232, 1616)], None),
        (Camera(1232, 1616, "Cam1"), [NCLT], "they are of camera Cam1, the map's of Cam5"),
        (Camera(1616, 1232), [NCLT], "they lie on their side: they are 1616 x 1232, the map's 1232 x 1616; turn them"),
        (Camera(1920, 1080), [NCLT], "they are of another shape, and so perhaps of another camera: 1920 x 1080, the"),
        (Camera(100, 100), [Camera(4, 3)], "another shape"),
    ],
)
def test_pictures_that_are_compared_badly_are_told(camera: Camera, cameras: list[Camera], says: str | None) -> None:
    reason = camera.unlike(cameras, "the map's")
    assert (reason is None) == (says is None)
    assert says is None or says in str(reason)


@pytest.mark.parametrize(
    ("camera", "cameras", "degrees"),
    [
        (Camera(1616, 1232), [NCLT], 90),
        (Camera(404, 308, "Cam5"), [Camera(640, 480), NCLT], 0),  # of a map of both shapes nobody can tell
        (Camera(404, 308), [Camera(800, 600)], 0),
        (Camera(404, 308), [], 0),
        (Camera(1600, 1200), [NCLT], 0),  # of another camera, that lies on either side
        (Camera(1616, 1232), [Camera(3, 4)], 0),
        (NCLT, [NCLT], 0),
        (NCLT, [Camera(1616, 1232)], 0),
    ],
)
def test_only_nclts_files_tell_which_way_they_lie(camera: Camera, cameras: list[Camera], degrees: int) -> None:
    assert camera.turn_to(cameras) == degrees


def test_shape_and_document() -> None:
    assert [Camera(*size).orientation for size in ((4, 3), (3, 4), (5, 5))] == ["landscape", "portrait", "square"]
    assert Camera.from_dict(NCLT.as_dict()) == NCLT
    assert Camera(4, 2).aspect_ratio == 2
