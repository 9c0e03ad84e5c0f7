"""Which evaluators and embedded extractors exist, by name; nothing is imported before it is asked for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from types import MappingProxyType
from typing import Any, cast

from deepsimbad.errors import InvalidInputError
from deepsimbad.evaluators.base import Evaluator


class EvaluatorKind(StrEnum):
    """The evaluators that are built."""

    FEATURE_L2 = "feature_l2"


class ExtractorName(StrEnum):
    """The extractors `feature_l2` can use; `none` takes ready encodings alone."""

    GRADIENT_GRID = "gradient_grid"
    NONE = "none"


DEFAULT_EXTRACTOR = ExtractorName.GRADIENT_GRID

_EVALUATORS: Mapping[EvaluatorKind, str] = {
    EvaluatorKind.FEATURE_L2: "deepsimbad.evaluators.feature_l2:FeatureL2",
}
_EXTRACTORS: Mapping[ExtractorName, str | None] = {
    ExtractorName.GRADIENT_GRID: "deepsimbad.evaluators.extractors.gradient_grid:GradientGrid",
    ExtractorName.NONE: None,
}
# Per kind: option -> (default, allowed values). Unknown options are errors: a typing mistake is never silent.
_OPTIONS: Mapping[EvaluatorKind, Mapping[str, tuple[str, tuple[str, ...]]]] = {
    EvaluatorKind.FEATURE_L2: {"extractor": (DEFAULT_EXTRACTOR.value, tuple(e.value for e in ExtractorName))},
}


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
    options: dict[str, str] = {}
    for name, (default, allowed) in known.items():
        value = raw.get(name, default)
        if not isinstance(value, str) or value not in allowed:
            raise InvalidInputError(
                f"{kind.value}'s {name} must be one of {', '.join(allowed)}",
                field=name,
                allowed=list(allowed),
            )
        options[name] = value
    return EvaluatorConfig(kind, MappingProxyType(options))


def make_evaluator(config: EvaluatorConfig) -> Evaluator:
    """Build the evaluator a configuration names.

    Raises:
        InvalidInputError: The options do not fit (only for configurations not made by `evaluator_config`).
    """
    checked = evaluator_config({"kind": config.kind, **config.options})
    return cast("Evaluator", _load(_EVALUATORS[checked.kind])(**checked.options))


def extractor_class(name: ExtractorName) -> Callable[[], Any] | None:
    """The class of an embedded extractor; None for `none`."""
    target = _EXTRACTORS[name]
    return None if target is None else _load(target)


def _load(target: str) -> Callable[..., Any]:
    module, _, attribute = target.partition(":")
    return cast("Callable[..., Any]", getattr(import_module(module), attribute))
