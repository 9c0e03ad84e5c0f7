"""One view, one answer: whatever of a picture is sent, the service encodes the same pixels."""

import io
import json
import shutil
from contextlib import contextmanager
from pathlib import Path

import cv2
import httpx2
import numpy as np
import pytest
from PIL import Image as Pillow

from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.grey_levels import measured_levels
from deepsimbad.evaluators.image import decode_image, is_blank, resized
from deepsimbad_client import Client
from deepsimbad_client.errors import InvalidInputError
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from ...commands import run_command
from ..conftest import serving

NCLT_US = 1_326_030_975_000_000
LIMIT = 50_000_000
EVALUATOR = {"kind": "feature_l2", "extractor": "gradient_grid"}


def scene(seed, size=(320, 240)):
    """A picture, [height, width, 3] uint8, with grains that resizing and JPEG change."""
    random = np.random.default_rng(seed)
    coarse = random.integers(30, 220, (9, 12, 3), np.uint8)
    grains = random.normal(0, 12, (size[1], size[0], 3))
    return np.clip(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) + grains, 0, 255).astype(np.uint8)


def on_its_side(image):
    exif, stream = Pillow.Exif(), io.BytesIO()
    exif[0x112] = 6
    Pillow.fromarray(image[..., ::-1]).save(stream, "JPEG", exif=exif)
    return stream.getvalue()


FILES = ("photo.jpg", "small.jpg", "photo.png", "photo.tiff", "photo.webp", "low.png", "turned.jpg", "large.jpg")
SIZES = {"small.jpg": (150, 140), "low.png": (300, 90), "large.jpg": (4000, 3000)}


def file_of(name):
    """The bytes of a file, made only on demand, since every process of a run imports this module."""
    image = scene(FILES.index(name), SIZES.get(name, (320, 240)))
    if name == "turned.jpg":
        return on_its_side(image)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 40] if name == "small.jpg" else []
    return cv2.imencode(Path(name).suffix, image, quality)[1].tobytes()


@pytest.mark.parametrize("name", FILES)
def test_what_is_sent_encodes_to_the_pixels_of_the_whole_picture(name, tmp_path):
    (tmp_path / name).write_bytes(body := file_of(name))
    recording, evaluator = open_source(str(tmp_path)), FeatureL2("gradient_grid")
    pixels = decode_image(body, LIMIT)
    for size in ((128, 128), (224, 224), (130, 97)):
        encoded = recording.image(recording.frames[0], size)
        assert len(encoded.body) <= max(len(body), 3 * size[0] * size[1])
        np.testing.assert_array_equal(resized(decode_image(encoded.body, LIMIT), size), resized(pixels, size))
    encoded = recording.image(recording.frames[0], evaluator.input_size)
    np.testing.assert_array_equal(evaluator.prepare(decode_image(encoded.body, LIMIT)), evaluator.prepare(pixels))


def test_whether_a_view_shows_nothing_does_not_hang_on_who_made_it_small():
    """Shrinking removes grains: judged at full size, one picture would be a view here and none there."""
    random = np.random.default_rng(1)
    night = np.clip(random.normal(20, 2.0, (480, 640, 3)), 0, 255).astype(np.uint8)
    evaluator = FeatureL2("gradient_grid")
    assert is_blank(evaluator.prepare(night)) == is_blank(evaluator.prepare(resized(night, (128, 128)))) is True


@contextmanager
def yard_client(data_dir, source):
    """A client of a service whose domain `yard` is mapped from a recording."""
    with serving(data_dir) as url, Client(url) as client:
        client.admin.put_domain("yard", EVALUATOR)
        upload(client, open_source(str(source)), "yard", "t")
        remap(client, "yard", "t", n_landmarks=8, list_length=4)
        yield client


def posted(client, media_type, *bodies):
    """The answers to images that are sent without the client."""
    address, header = f"{client.url}/v1/domains/yard/localizations", {"Content-Type": media_type}
    return [httpx2.post(address, content=body, headers=header).json() for body in bodies]


def printed(program, *words, **environment):
    """The answers that `localize` prints, and what it says beside them."""
    result = run_command([program, "localize", *words, "--json"], **environment)
    assert result.code == 0, result.err
    return json.loads(result.out), result.err


def test_a_view_has_one_answer_by_every_route(tmp_path):
    drive, looks, data_dir = (tmp_path / name for name in ("drive", "looks", "data"))
    drive.mkdir()
    looks.mkdir()
    for place in range(12):
        cv2.imwrite(str(drive / f"{place:02}.png"), scene(100 + place))
    for number, form in enumerate(("jpg", "png", "tiff")):
        cv2.imwrite(str(looks / f"{number}.{form}"), cv2.convertScaleAbs(scene(103 + 3 * number), alpha=0.8, beta=15))
    paths, environment = sorted(looks.iterdir()), {"DEEPSIMBAD_DATA_DIR": str(data_dir)}
    with yard_client(data_dir, drive) as client:
        by_python = [client.localize("yard", path).model_dump(mode="json") for path in paths]
        eyes = client.on_board("yard")
        by_ranks = [client.localize("yard", on_board=eyes.ranks(path, m=8)) for path in paths]
        answers = [
            posted(client, "image/jpeg", *(path.read_bytes() for path in paths)),
            printed("deepsimbad-client", "yard", *paths, "--server", client.url)[0],
            printed("deepsimbad-client", looks, "--domain", "yard", "--server", client.url)[0],
        ]
        assert run_command(["deepsimbad-client", "localize", "yard", "--server", client.url]).code == 2
    make = ["deepsimbad", "map", "own", "--training", drive, "--evaluator", "feature_l2:gradient_grid"]
    assert run_command([*make, "--n-landmarks", "8"], **environment).code == 0
    answers += [printed("deepsimbad", domain, *paths, **environment)[0] for domain in ("yard", "own")]
    assert [expected["belief"]["mode_m"] for expected in by_python] == [3, 6, 9], "else nothing is shown"
    for other in answers:
        for part in ("belief", "retrieval", "informative"):
            assert [answer[part] for answer in other] == [expected[part] for expected in by_python]
    for expected, answer in zip(by_python, by_ranks, strict=True):
        # Eight ranks are less than an encoding: they need not agree on the very best.
        assert expected["retrieval"][0]["map_image"] in [image.map_image for image in answer.retrieval[:3]]


def write_nclt(root, date, n, alpha=1.0):
    """A drive in NCLT's layout: files that lie on their side."""
    camera = root / date / "lb3" / "Cam5"
    camera.mkdir(parents=True)
    (root / "ground_truth").mkdir(exist_ok=True)
    for place in range(n):
        lying = cv2.rotate(scene(100 + place, (308, 404)), cv2.ROTATE_90_COUNTERCLOCKWISE)
        path = camera / f"{NCLT_US + 500_000 * place}.tiff"
        cv2.imwrite(str(path), cv2.convertScaleAbs(lying, alpha=alpha, beta=10))
    rows = (f"{NCLT_US - 100_000 + 10_000 * row},{(row - 10) / 50},0,0,0,0,0" for row in range(50 * n + 20))
    (root / "ground_truth" / f"groundtruth_{date}.csv").write_text("\n".join(rows))
    return camera


def test_a_raw_image_of_nclt_has_one_answer_by_every_route(tmp_path):
    """A raw image, whoever sends it, is turned as the map's images were, and the answer says so."""
    write_nclt(tmp_path / "nclt", "2012-01-08", 12)
    looks = write_nclt(tmp_path / "nclt", "2012-02-05", 12, alpha=0.8)
    loose, data_dir = tmp_path / "loose", tmp_path / "data"
    shutil.copytree(looks, loose)
    paths = sorted(loose.iterdir())[2:5]
    commands = {
        "files": paths,
        "drive": [f"nclt:{tmp_path}/nclt/2012-02-05#2:5"],
        "camera's folder": [f"{looks}#2:5"],
        "folder": [f"{loose}#2:5"],
    }
    with yard_client(data_dir, f"nclt:{tmp_path}/nclt/2012-01-08") as client:
        answers = {"Python": [client.localize("yard", path).model_dump(mode="json") for path in paths]}
        with client.session("yard") as session:
            in_session = session.observe(paths[0])
        by_curl = posted(client, "image/tiff", *(path.read_bytes() for path in paths))
        for route, words in commands.items():
            answers[f"client, {route}"], _ = printed("deepsimbad-client", "yard", *words, "--server", client.url)
    for route, words in commands.items():
        answers[f"here, {route}"], remarks = printed("deepsimbad", "yard", *words, "--data-dir", data_dir)
        assert remarks.count("upright") == (route != "drive")
    assert [answer["belief"]["mode_m"] for answer in by_curl] == pytest.approx([2.2, 3.2, 4.2]), "else nothing is shown"
    for answer in (by_curl[0], in_session.model_dump()):
        assert any("as NCLT's files do: it was turned by 90 degrees" in warning for warning in answer["warnings"])
    for route, route_answers in answers.items():
        for answer, expected in zip(route_answers, by_curl, strict=True):
            assert (answer["belief"], answer["retrieval"]) == (expected["belief"], expected["retrieval"]), route


def deep(seed):
    """A picture of a 12-bit camera with a pedestal, as uint16."""
    return (2000 + 2 * scene(seed)[..., 1].astype(np.uint16)).astype(np.uint16)


def test_views_of_more_than_eight_bits_are_shown_as_their_map_was(tmp_path):
    drive, look, data_dir = (tmp_path / name for name in ("drive", "look.png", "data"))
    drive.mkdir()
    for place in range(12):
        cv2.imwrite(str(drive / f"{place:02}.png"), deep(100 + place))
    cv2.imwrite(str(drive / "12.png"), np.full((240, 320), 2300, np.uint16))  # the lens was covered
    sunny = deep(105)
    sunny[:12, :60] = 4000  # which would change the levels of the picture alone
    cv2.imwrite(str(look), sunny)
    image, levels = look.read_bytes(), open_source(str(drive)).grey_levels
    with yard_client(data_dir, drive) as client:
        stored = client.admin.traverse("yard", "t")
        assert (stored.grey_levels, stored.n_uninformative) == (levels, 1)
        assert upload(client, open_source(f"{drive}#3:6"), "yard", "t").n_skipped == 3
        assert client.admin.maps("yard")[0].metrics["n_uninformative"] == 1
        assert client.domain("yard").grey_levels == levels
        (by_curl,) = posted(client, "image/png", image)
        eyes = client.on_board("yard")
        assert eyes.ranks(look, m=8) == eyes.ranks(decode_image(image, LIMIT, levels=levels), m=8)
        with client.session("yard") as session:
            in_session = session.observe(image=image)
            bright = session.observe(image=cv2.imencode(".png", deep(105) + np.uint16(200))[1].tobytes())
            flat = session.observe(image=cv2.imencode(".png", scene(105) >> 5)[1].tobytes())
        answers = printed("deepsimbad-client", "yard", look, "--server", client.url)[0]
        client.admin.create_traverse("yard", "raw")
        for place, name in enumerate(("12.png", "00.png", "01.png")):
            client.admin.put_frame("yard", "raw", place, (drive / name).read_bytes(), position_m=place)
        raw = client.admin.traverse("yard", "raw")
        assert raw.n_uninformative == 1
        assert raw.grey_levels == measured_levels([cv2.imread(str(drive / "00.png"), cv2.IMREAD_UNCHANGED)])
        with pytest.raises(InvalidInputError, match="black and white"):
            client.admin.create_traverse("yard", "odd", grey_levels=(9, 9))
    answers += printed("deepsimbad", "yard", look, "--data-dir", data_dir)[0]
    assert by_curl["belief"]["mode_m"] == 5
    assert [(answer["belief"], answer["retrieval"]) for answer in answers] == 2 * [
        (by_curl["belief"], by_curl["retrieval"])
    ]
    assert any("another bit depth" in warning for warning in bright.warnings)
    assert not any("bit depth" in warning for warning in [*in_session.warnings, *flat.warnings])
    assert any("8 grey levels of 256" in warning for warning in flat.warnings)
    assert not any("grey levels" in warning for warning in [*in_session.warnings, *by_curl["warnings"]])
