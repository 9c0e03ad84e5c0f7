"""`OnBoardEncoder`: fetched by either client or loaded from a file, and all that can be wrong with it."""

import subprocess
import sys

import cv2
import httpx2
import numpy as np
import pytest

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.landmark_model import PortableLandmarks, landmark_model_digest, pack_landmarks
from deepsimbad.core.on_board import unpack_ranked_landmarks, unpack_unit_encoding
from deepsimbad.errors import MissingPackageError
from deepsimbad.evaluators.image import decode_image
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad_client import Client, errors
from deepsimbad_client.http.on_board import OnBoardEncoder

from .scripted import Script, answer

N_LANDMARKS = 300
GRADIENTS = {"kind": "feature_l2", "extractor": "gradient_grid"}
RANKS, UNIT_ENCODING = "application/vnd.deepsimbad.ranks", "application/vnd.deepsimbad.unit-encoding"


def picture(seed):
    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return bytes(cv2.imencode(".png", cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC))[1].tobytes())


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    dim = make_evaluator(evaluator_config(GRADIENTS)).encoding_dim
    landmarks = rng.random((N_LANDMARKS, dim)).astype(np.float32)
    return {"prototypes": landmarks / np.linalg.norm(landmarks, axis=1, keepdims=True)}


@pytest.fixture(scope="module")
def content(model):
    return pack_landmarks(PortableLandmarks(model, N_LANDMARKS, 4, GRADIENTS))


def slow_order(body, model):
    evaluator = make_evaluator(evaluator_config(GRADIENTS))
    encoding = evaluator.encode([decode_image(body, 1 << 20)])[0]
    dissimilarities = np.square(model["prototypes"].astype(float) - encoding).sum(axis=1)
    return sorted(range(N_LANDMARKS), key=lambda landmark: (dissimilarities[landmark], landmark))


def test_an_observation_is_64_bytes_of_the_nearest(content, model):
    encoder = OnBoardEncoder(content)
    assert (encoder.map_version, encoder.n_landmarks) == (4, N_LANDMARKS)
    assert encoder.digest == landmark_model_digest(model)
    order = slow_order(picture(1), model)
    observation = encoder.ranks(picture(1))
    assert observation.headers == {"Content-Type": RANKS, "If-Match": f'"{encoder.digest}"'}
    assert len(observation.body) == 64
    assert encoder.view(picture(1)) == observation, "its map compares ranks"
    assert list(unpack_ranked_landmarks(observation.body, N_LANDMARKS)) == order[:55]
    for m in (1, 8, N_LANDMARKS):
        assert list(unpack_ranked_landmarks(encoder.ranks(picture(1), m=m).body, N_LANDMARKS)) == order[:m]


def test_an_image_may_be_bytes_a_path_or_an_array_and_a_saved_file_needs_no_network(content, tmp_path):
    fetched, body, path = OnBoardEncoder(content), picture(2), tmp_path / "view.png"
    path.write_bytes(body)
    fetched.save(tmp_path / "campus.npz")
    loaded = OnBoardEncoder.load(tmp_path / "campus.npz")
    assert loaded.digest == fetched.digest
    forms = (body, bytearray(body), path, str(path), decode_image(body, 1 << 20))
    assert len({encoder.ranks(form).body for form in forms for encoder in (fetched, loaded)}) == 1
    with pytest.raises(errors.NotSavedError):
        fetched.save(tmp_path / "nowhere" / "campus.npz")
    with pytest.raises(errors.SourceError, match="nothing"):
        OnBoardEncoder.load(tmp_path / "nothing.npz")


def test_a_picture_of_nothing_says_so(content):
    dark = OnBoardEncoder(content).view(np.zeros((60, 80, 3), np.uint8))
    assert dark.content_type == "application/json"
    assert dark.body == b'{"dissimilarities":[' + b",".join([b"0"] * N_LANDMARKS) + b"]}"


def test_ready_encodings_are_ranked_too(model):
    ready = {"kind": "feature_l2", "extractor": "none"}
    encoder = OnBoardEncoder(pack_landmarks(PortableLandmarks(model, N_LANDMARKS, 1, ready)))
    encoding = model["prototypes"][7]
    landmarks = unpack_ranked_landmarks(encoder.ranks(encoding=encoding, m=3).body, N_LANDMARKS)
    nearest = rank_landmarks(np.square(model["prototypes"] - encoding).sum(axis=1))
    assert [nearest[landmark] for landmark in landmarks] == [1, 2, 3]
    with pytest.raises(errors.InvalidArgumentError, match="takes ready encodings alone"):
        encoder.ranks(picture(1))
    with pytest.raises(errors.InvalidArgumentError, match="another encoder"):
        encoder.ranks(encoding=[1.0, 2.0])


def test_landmarks_that_are_unit_vectors_are_ranked_by_what_is_usual_of_encodings():
    rng = np.random.default_rng(1)
    prototypes, mean_and_scale, projection = rng.normal(size=(40, 3)), rng.random((2, 8)) + 1, rng.normal(size=(8, 3))
    prototypes /= np.linalg.norm(prototypes, axis=1, keepdims=True)
    model = {"prototypes": prototypes, "usual": mean_and_scale, "projection": projection}
    model = {name: array.astype(np.float32) for name, array in model.items()}
    encoder = OnBoardEncoder(
        pack_landmarks(PortableLandmarks(model, 40, 1, {"kind": "feature_l2", "extractor": "none"}))
    )
    encoding = rng.normal(size=8)
    likeness = prototypes @ ((encoding - mean_and_scale[0]) / mean_and_scale[1] @ projection)
    landmarks = unpack_ranked_landmarks(encoder.ranks(encoding=encoding, m=40).body, 40)
    assert list(landmarks) == np.argsort(-likeness).tolist()
    u = (encoding - mean_and_scale[0]) / mean_and_scale[1] @ projection
    observation = encoder.view(encoding=encoding, n_bits=8)
    assert observation.headers == {"Content-Type": UNIT_ENCODING, "If-Match": f'"{encoder.digest}"'}
    assert unpack_unit_encoding(observation.body, 3) == pytest.approx(u / np.linalg.norm(u), abs=0.01)
    assert len(encoder.view(encoding=encoding).body) == 1 + 2
    for n_bits in (1, 9):
        with pytest.raises(errors.InvalidArgumentError, match="2 to 8 bits"):
            encoder.view(encoding=encoding, n_bits=n_bits)
    with pytest.raises(errors.InvalidArgumentError, match="another encoder"):
        encoder.ranks(encoding=[1.0, 2.0, 3.0])
    unfit = pack_landmarks(PortableLandmarks({**model, "usual": model["usual"][:, :5]}, 40, 1, {"kind": "feature_l2"}))
    with pytest.raises(errors.InvalidLandmarkModelError):
        OnBoardEncoder(unfit)


def test_arguments_that_cannot_be(content, tmp_path):
    encoder = OnBoardEncoder(content)
    for m in (0, -1, N_LANDMARKS + 1):
        with pytest.raises(errors.InvalidArgumentError, match="send 1 to 300"):
            encoder.ranks(picture(1), m=m)
    with pytest.raises(errors.InvalidArgumentError, match="exactly one"):
        encoder.ranks()
    with pytest.raises(errors.InvalidArgumentError, match="uint8"):
        encoder.ranks(np.zeros((60, 80), np.uint8))
    for broken in (b"", b"hello", picture(1)[:-20], tmp_path / "nothing.png"):
        with pytest.raises(errors.BrokenFrameError):
            encoder.ranks(broken)
    with pytest.raises(errors.InvalidArgumentError, match="exactly one"):
        Client("http://service").localize("campus", picture(1), on_board=encoder.ranks(picture(1)))


def test_models_that_this_version_cannot_rank_by(model):
    unfit = [(N_LANDMARKS, {"kind": "crystal_ball"}), (N_LANDMARKS - 1, GRADIENTS)]
    packed = [pack_landmarks(PortableLandmarks(model, n, 1, evaluator)) for n, evaluator in unfit]
    for content in (b"", b"PK\x03\x04", b"no zip", *packed):
        with pytest.raises(errors.InvalidLandmarkModelError):
            OnBoardEncoder(content)


def test_other_weights_and_a_missing_package_are_named(content, model, monkeypatch):
    map_sha256 = "5" * 64
    encoder = OnBoardEncoder(pack_landmarks(PortableLandmarks(model, N_LANDMARKS, 1, GRADIENTS, map_sha256)))
    for encode in (encoder.load_extractor, lambda: encoder.ranks(picture(1))):
        with pytest.raises(errors.OtherWeightsError, match=f"none.*{map_sha256}"):
            encode()

    def missing():
        raise MissingPackageError("the extractor needs torch")

    encoder = OnBoardEncoder(content)
    monkeypatch.setattr(encoder._evaluator, "load", missing)
    with pytest.raises(errors.MissingExtraError, match=r"pip install 'deep-simbad\[edge\]'"):
        encoder.load_extractor()


def test_it_is_fetched_for_a_map_and_sent_as_it_is(content):
    problem = {"code": "landmark_model_differs", "detail": "another", "map_version": 9}
    model = httpx2.Response(200, content=content)
    script = Script(model, model, answer(409, problem))
    with script.client() as client:
        fetched = client.on_board("campus")
        assert client.on_board("campus", map_version=3).digest == fetched.digest
        observation = fetched.ranks(picture(1))
        with pytest.raises(errors.LandmarkModelDiffersError, match="map_version=9"):
            client.localize("campus", on_board=observation)
    base = "http://service/v1/domains/campus/landmark-model"
    assert [str(request.url) for request in script.requests[:2]] == [base, f"{base}?map_version=3"]
    third = script.requests[2]
    assert (third.headers["content-type"], third.headers["if-match"]) == (RANKS, f'"{fetched.digest}"')
    assert third.content == observation.body


HIDDEN = {"fastapi", "starlette", "uvicorn", "sqlite_utils", "prometheus_client", "pydantic_settings"}
CODE = """
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden}:
            raise ModuleNotFoundError("hidden: " + name)
sys.meta_path.insert(0, Hide())
from deepsimbad_client.http.on_board import OnBoardEncoder
print(len(OnBoardEncoder.load("campus.npz").ranks("view.png").body))
"""


def test_encoding_on_board_needs_nothing_of_the_service_but_core_and_evaluators(tmp_path, content):
    OnBoardEncoder(content).save(tmp_path / "campus.npz")
    (tmp_path / "view.png").write_bytes(picture(1))
    program = [sys.executable, "-c", CODE.replace("{hidden}", repr(HIDDEN))]
    process = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert process.stdout == "64\n", process.stderr
