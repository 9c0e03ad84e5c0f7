"""Options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from deepsimbad.core.relevance import Relevance
from deepsimbad.evaluators.registry import EvaluatorConfig, EvaluatorKind, ExtractorName, evaluator_config

_Command = TypeVar("_Command", bound=Callable[..., Any])

RELEVANCES = click.Choice([relevance.value for relevance in Relevance])


def data_dir_option(command: _Command) -> _Command:
    """`--data-dir`, else $DEEPSIMBAD_DATA_DIR, else ./deepsimbad-data."""
    return click.option(
        "--data-dir",
        type=click.Path(file_okay=False, path_type=Path),
        help="Folder of domains and maps.  [default: $DEEPSIMBAD_DATA_DIR, else ./deepsimbad-data]",
    )(command)


def evaluator_option(command: _Command) -> _Command:
    """`--evaluator KIND[:EXTRACTOR]`, given on as an EvaluatorConfig."""
    names = ", ".join(f"{EvaluatorKind.FEATURE_L2}:{extractor}" for extractor in ExtractorName)
    return click.option(
        "--evaluator",
        default=EvaluatorKind.FEATURE_L2.value,
        show_default=True,
        callback=_evaluator,
        help=f"How images are compared with landmarks: a kind, or one of {names}.",
    )(command)


def spacing_option(command: _Command) -> _Command:
    """`--spacing-m` for sources without positions."""
    return click.option(
        "--spacing-m",
        type=click.FloatRange(min=0, min_open=True),
        default=1.0,
        show_default=True,
        help="Metres between frames of a source without positions.",
    )(command)


def _evaluator(_context: click.Context, _parameter: click.Parameter, value: str) -> EvaluatorConfig:
    kind, _, extractor = value.partition(":")
    return evaluator_config({"kind": kind, **({"extractor": extractor} if extractor else {})})
