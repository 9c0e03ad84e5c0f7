"""Configurations from outside."""

import subprocess
import sys

import pytest

from deepsimbad.errors import InvalidInputError
from deepsimbad.evaluators.registry import (
    DEFAULT_EXTRACTOR,
    EvaluatorKind,
    ExtractorName,
    evaluator_config,
    extractor_class,
    make_evaluator,
)


def test_defaults_are_filled_in():
    config = evaluator_config({"kind": "feature_l2"})
    assert config.as_dict() == {"kind": "feature_l2", "extractor": DEFAULT_EXTRACTOR.value}
    assert evaluator_config(config.as_dict()) == config


def test_order_does_not_matter():
    one = evaluator_config({"extractor": "none", "kind": "feature_l2"})
    assert one.as_dict() == evaluator_config({"kind": "feature_l2", "extractor": "none"}).as_dict()


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
    assert make_evaluator(evaluator_config({"kind": kind.value}))


@pytest.mark.parametrize("name", [e for e in ExtractorName if e is not ExtractorName.NONE])
def test_every_extractor_is_registered_under_its_own_name(name):
    made = extractor_class(name)
    assert made is not None
    assert made().name == name.value
    assert made().encoding_dim <= 4096


def test_nothing_is_imported_before_it_is_asked_for():
    code = (
        "import sys; import deepsimbad.evaluators.registry; "
        "sys.exit(any(m in sys.modules for m in ('cv2', 'torch', 'deepsimbad.evaluators.feature_l2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
