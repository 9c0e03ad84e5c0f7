"""One view, one answer: whatever of a picture is sent, the service encodes the same pixels."""

import io
import json
import shutil
from pathlib import Path

import cv2
import httpx2
import numpy as np
import pytest
from PIL import Image as Pillow

from deepsimbad.cli import run as run_service
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.grey_levels import measured_levels
from deepsimbad.evaluators.image import decode_image, is_blank, resized
from deepsimbad_client import Client
from deepsimbad_client.commands import run
from deepsimbad_client.errors import InvalidInputError
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

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


def test_a_view_has_one_answer_by_every_route(tmp_path, capsys):
    drive, looks = tmp_path / "drive", tmp_path / "looks"
    for folder in (drive, looks):
        folder.mkdir()
    for place in range(12):
        cv2.imwrite(str(drive / f"{place:02}.png"), scene(100 + place))
    for number, form in enumerate(("jpg", "png", "tiff")):
        cv2.imwrite(str(looks / f"{number}.{form}"), cv2.convertScaleAbs(scene(103 + 3 * number), alpha=0.8, beta=15))
    paths, data_dir = sorted(map(str, looks.iterdir())), str(tmp_path / "data")
    with serving(tmp_path / "data") as url, Client(url) as client:
        client.admin.put_domain("yard", EVALUATOR)
        upload(client, open_source(str(drive)), "yard", "t")
        remap(client, "yard", "t", n_landmarks=8, list_length=4)
        by_python = [client.localize("yard", path) for path in paths]
        bodies = [(looks / path).read_bytes() for path in paths]
        address, header = f"{url}/v1/domains/yard/localizations", {"Content-Type": "image/jpeg"}
        by_curl = [httpx2.post(address, content=body, headers=header).json() for body in bodies]
        eyes = client.on_board("yard")
        by_ranks = [client.localize("yard", on_board=eyes.ranks(path, m=8)) for path in paths]
        capsys.readouterr()
        assert run(["localize", "yard", *paths, "--server", url, "--json"]) == 0
        assert run(["localize", "yard", "--server", url]) == 2
        by_command = json.loads(capsys.readouterr().out)
        assert run(["localize", str(looks), "--domain", "yard", "--server", url, "--json"]) == 0
        by_folder = json.loads(capsys.readouterr().out)
    assert run_service(["localize", "yard", *paths, "--data-dir", data_dir, "--json"]) == 0
    by_service_command = json.loads(capsys.readouterr().out)
    made_here = ["map", "own", "--training", str(drive), "--evaluator", "feature_l2:gradient_grid"]
    assert run_service([*made_here, "--n-landmarks", "8", "--data-dir", data_dir]) == 0
    capsys.readouterr()
    assert run_service(["localize", "own", *paths, "--data-dir", data_dir, "--json"]) == 0
    by_own_map = json.loads(capsys.readouterr().out)
    for number, answer in enumerate(by_python):
        expected = answer.model_dump(mode="json")
        assert expected["belief"]["mode_m"] == 3 * (number + 1), "else nothing is shown"
        for other in (by_curl, by_command, by_folder, by_service_command, by_own_map):
            for part in ("belief", "retrieval", "informative"):
                assert other[number][part] == expected[part]
        # Eight ranks are less than an encoding: they need not agree on the very best.
        best = [image.map_image for image in by_ranks[number].retrieval[:3]]
        assert expected["retrieval"][0]["map_image"] in best


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


def test_a_raw_image_of_nclt_has_one_answer_by_every_route(tmp_path, capsys):
    """A raw image, whoever sends it, is turned as the map's images were, and the answer says so."""
    write_nclt(tmp_path / "nclt", "2012-01-08", 12)
    looks = write_nclt(tmp_path / "nclt", "2012-02-05", 12, alpha=0.8)
    loose = tmp_path / "loose"
    shutil.copytree(looks, loose)
    paths, data_dir = sorted(map(str, loose.iterdir()))[2:5], str(tmp_path / "data")
    with serving(tmp_path / "data") as url, Client(url) as client:
        client.admin.put_domain("yard", EVALUATOR)
        upload(client, open_source(f"nclt:{tmp_path}/nclt/2012-01-08"), "yard", "t")
        remap(client, "yard", "t", n_landmarks=8, list_length=4)
        answers = {"Python": [client.localize("yard", path).model_dump(mode="json") for path in paths]}
        with client.session("yard") as session:
            in_session = session.observe(paths[0])
        address, header = f"{url}/v1/domains/yard/localizations", {"Content-Type": "image/tiff"}
        posted = [httpx2.post(address, content=Path(path).read_bytes(), headers=header).json() for path in paths]
        commands = {
            "files": ["yard", *paths],
            "drive": ["yard", f"nclt:{tmp_path}/nclt/2012-02-05#2:5"],
            "camera's folder": ["yard", f"{looks}#2:5"],
            "folder": ["yard", f"{loose}#2:5"],
        }
        capsys.readouterr()
        for route, words in commands.items():
            assert run(["localize", *words, "--server", url, "--json"]) == 0
            answers[f"client, {route}"] = json.loads(capsys.readouterr().out)
    for route, words in commands.items():
        assert run_service(["localize", *words, "--data-dir", data_dir, "--json"]) == 0
        out, err = capsys.readouterr()
        answers[f"here, {route}"] = json.loads(out)
        assert err.count("upright") == (route != "drive")
    assert [answer["belief"]["mode_m"] for answer in posted] == pytest.approx([2.2, 3.2, 4.2]), "else nothing is shown"
    for answer in (posted[0], in_session.model_dump()):
        assert any("as NCLT's files do: it was turned by 90 degrees" in warning for warning in answer["warnings"])
    for route, route_answers in answers.items():
        for answer, expected in zip(route_answers, posted, strict=True):
            assert (answer["belief"], answer["retrieval"]) == (expected["belief"], expected["retrieval"]), route


def deep(seed):
    """A picture of a 12-bit camera with a pedestal, as uint16."""
    return (2000 + 2 * scene(seed)[..., 1].astype(np.uint16)).astype(np.uint16)


def test_views_of_more_than_eight_bits_are_shown_as_their_map_was(tmp_path, capsys):
    drive, look, data_dir = tmp_path / "drive", tmp_path / "look.png", str(tmp_path / "data")
    drive.mkdir()
    for place in range(12):
        cv2.imwrite(str(drive / f"{place:02}.png"), deep(100 + place))
    cv2.imwrite(str(drive / "12.png"), np.full((240, 320), 2300, np.uint16))  # the lens was covered
    sunny = deep(105)
    sunny[:12, :60] = 4000  # which would change the levels of the picture alone
    cv2.imwrite(str(look), sunny)
    levels = open_source(str(drive)).grey_levels
    image, header = look.read_bytes(), {"Content-Type": "image/png"}
    with serving(tmp_path / "data") as url, Client(url) as client:
        client.admin.put_domain("yard", EVALUATOR)
        upload(client, open_source(str(drive)), "yard", "t")
        stored = client.admin.traverse("yard", "t")
        assert (stored.grey_levels, stored.n_uninformative) == (levels, 1)
        assert upload(client, open_source(f"{drive}#3:6"), "yard", "t").n_skipped == 3
        job = remap(client, "yard", "t", n_landmarks=8, list_length=4)
        assert job.result["metrics"]["n_uninformative"] == 1
        assert client.domain("yard").grey_levels == levels
        by_curl = httpx2.post(f"{url}/v1/domains/yard/localizations", content=image, headers=header).json()
        eyes = client.on_board("yard")
        assert eyes.ranks(look, m=8) == eyes.ranks(decode_image(image, LIMIT, levels=levels), m=8)
        with client.session("yard") as session:
            in_session = session.observe(image=image)
            bright = session.observe(image=cv2.imencode(".png", deep(105) + np.uint16(200))[1].tobytes())
            flat = session.observe(image=cv2.imencode(".png", scene(105) >> 5)[1].tobytes())
        capsys.readouterr()
        assert run(["localize", str(look), "--domain", "yard", "--server", url, "--json"]) == 0
        (by_command,) = json.loads(capsys.readouterr().out)
        frame = f"{url}/v1/admin/domains/yard/traverses/raw/frames"
        client.admin.create_traverse("yard", "raw")
        for place, name in enumerate(("12.png", "00.png", "01.png")):
            body = (drive / name).read_bytes()
            httpx2.put(f"{frame}/{place}?position_m={place}", content=body, headers=header).raise_for_status()
        raw = client.admin.traverse("yard", "raw")
        assert raw.n_uninformative == 1
        assert raw.grey_levels == measured_levels([cv2.imread(str(drive / "00.png"), cv2.IMREAD_UNCHANGED)])
        with pytest.raises(InvalidInputError, match="black and white"):
            client.admin.create_traverse("yard", "odd", grey_levels=(9, 9))
    assert run_service(["localize", "yard", str(look), "--data-dir", data_dir, "--json"]) == 0
    (by_service_command,) = json.loads(capsys.readouterr().out)
    assert by_curl["belief"]["mode_m"] == 5
    for other in (by_command, by_service_command):
        assert (other["belief"], other["retrieval"]) == (by_curl["belief"], by_curl["retrieval"])
    assert any("another bit depth" in warning for warning in bright.warnings)
    assert not any("bit depth" in warning for warning in [*in_session.warnings, *flat.warnings])
    assert any("8 grey levels of 256" in warning for warning in flat.warnings)
    assert not any("grey levels" in warning for warning in [*in_session.warnings, *by_curl["warnings"]])
