"""One view, one answer: whatever of a picture is sent, the service encodes the same pixels."""

import io
import json

import cv2
import httpx2
import numpy as np
import pytest
from PIL import Image as Pillow

from deepsimbad.cli import run as run_service
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.evaluators.image import decode_image, is_blank, resized
from deepsimbad_client import Client
from deepsimbad_client.commands import run
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from ..conftest import serving

LIMIT = 50_000_000
EVALUATOR = {"kind": "feature_l2", "extractor": "gradient_grid"}


def scene(seed, size=(320, 240)):
    """[height, width, 3] with small grains, on which resizing and JPEG have something to do."""
    random = np.random.default_rng(seed)
    coarse = random.integers(30, 220, (9, 12, 3), np.uint8)
    grains = random.normal(0, 12, (size[1], size[0], 3))
    return np.clip(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) + grains, 0, 255).astype(np.uint8)


def on_its_side(image):
    exif, stream = Pillow.Exif(), io.BytesIO()
    exif[0x112] = 6
    Pillow.fromarray(image[..., ::-1]).save(stream, "JPEG", exif=exif)
    return stream.getvalue()


FILES = {
    "photo.jpg": cv2.imencode(".jpg", scene(0))[1].tobytes(),
    "small.jpg": cv2.imencode(".jpg", scene(1, (150, 140)), [cv2.IMWRITE_JPEG_QUALITY, 40])[1].tobytes(),
    "photo.png": cv2.imencode(".png", scene(2))[1].tobytes(),
    "photo.tiff": cv2.imencode(".tiff", scene(3))[1].tobytes(),
    "photo.webp": cv2.imencode(".webp", scene(4))[1].tobytes(),
    "low.png": cv2.imencode(".png", scene(5, (300, 90)))[1].tobytes(),
    "turned.jpg": on_its_side(scene(6)),
    "large.jpg": cv2.imencode(".jpg", scene(7, (4000, 3000)))[1].tobytes(),
}


@pytest.mark.parametrize("name", FILES)
def test_what_is_sent_encodes_to_the_pixels_of_the_whole_picture(name, tmp_path):
    (tmp_path / name).write_bytes(FILES[name])
    recording, evaluator = open_source(str(tmp_path)), FeatureL2("gradient_grid")
    pixels = decode_image(FILES[name], LIMIT)
    for size in ((128, 128), (224, 224), (130, 97)):
        sent = recording.image(recording.frames[0], size)
        assert len(sent.body) <= max(len(FILES[name]), 3 * size[0] * size[1])
        np.testing.assert_array_equal(resized(decode_image(sent.body, LIMIT), size), resized(pixels, size))
    sent = recording.image(recording.frames[0], evaluator.input_size)
    np.testing.assert_array_equal(evaluator.prepare(decode_image(sent.body, LIMIT)), evaluator.prepare(pixels))


def test_whether_a_view_shows_nothing_does_not_hang_on_who_made_it_small():
    """Grains go when a picture shrinks: judged at full size, the same dark would be a view here and none there."""
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
        at, header = f"{url}/v1/domains/yard/localizations", {"Content-Type": "image/jpeg"}
        by_curl = [httpx2.post(at, content=body, headers=header).json() for body in bodies]
        on_board = client.on_board("yard")
        by_ranks = [client.localize("yard", ranked=on_board.ranks(path, m=8)) for path in paths]
        capsys.readouterr()
        assert run(["localize", *paths, "--domain", "yard", "--server", url, "--json"]) == 0
        by_command = json.loads(capsys.readouterr().out)
        assert run(["localize", str(looks), "--domain", "yard", "--server", url, "--json"]) == 0
        by_folder = json.loads(capsys.readouterr().out)
    assert run_service(["localize", "yard", *paths, "--data-dir", data_dir, "--json"]) == 0
    here = json.loads(capsys.readouterr().out)
    made_here = ["map", "own", "--training", str(drive), "--evaluator", "feature_l2:gradient_grid"]
    assert run_service([*made_here, "--n-landmarks", "8", "--data-dir", data_dir]) == 0
    capsys.readouterr()
    assert run_service(["localize", "own", *paths, "--data-dir", data_dir, "--json"]) == 0
    by_own_map = json.loads(capsys.readouterr().out)
    for number, answer in enumerate(by_python):
        expected = answer.model_dump(mode="json")
        assert expected["belief"]["mode_m"] == 3 * (number + 1), "else nothing is shown"
        for other in (by_curl, by_command, by_folder, here, by_own_map):
            for part in ("belief", "retrieval", "informative"):
                assert other[number][part] == expected[part]
        assert by_ranks[number].retrieval[0].map_image == expected["retrieval"][0]["map_image"]
