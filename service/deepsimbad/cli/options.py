"""Options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import UnknownDomainError
from deepsimbad.evaluators.registry import (
    EXTRACTOR_FORMS,
    EvaluatorConfig,
    EvaluatorKind,
    ExtractorName,
    default_extractor,
    evaluator_config,
    fallback,
)
from deepsimbad.evaluators.weights.lock import Lock
from deepsimbad.settings import Settings, TracedSettings, trace_settings
from deepsimbad.store.layout import catalog_path

_Command = TypeVar("_Command", bound=Callable[..., Any])

_CONFIG = "deepsimbad.config"

RELEVANCES = click.Choice([relevance.value for relevance in Relevance])
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
spacing_option = click.option(
    "--spacing-m",
    type=click.FloatRange(min=0, min_open=True),
    default=1.0,
    show_default=True,
    help="Metres between frames of a source without positions.",
)


def _remember_config(context: click.Context, _parameter: click.Parameter, value: Path | None) -> None:
    context.meta[_CONFIG] = value


config_option = click.option(
    "--config",
    type=click.Path(path_type=Path),
    expose_value=False,
    callback=_remember_config,  # for `traced_settings`
    help="TOML file of settings.  [default: $DEEPSIMBAD_CONFIG, else ./deepsimbad.toml if it is there]",
)


def data_dir_option(command: _Command) -> _Command:
    """`--data-dir`, else as settings say, else ./deepsimbad-data; with `--config`."""
    return click.option(
        "--data-dir",
        type=click.Path(file_okay=False, path_type=Path),
        help="Folder of domains and maps.  [default: $DEEPSIMBAD_DATA_DIR, else ./deepsimbad-data]",
    )(config_option(command))


def traced_settings(**flags: object) -> TracedSettings:
    """The settings of the command that runs, each with its origin: flags, environment, settings file, defaults.

    Args:
        **flags: Settings by name; None counts as not given.

    Raises:
        SettingsError: The file cannot be read, a name is unknown or a value cannot be used.
    """
    return trace_settings(click.get_current_context().meta.get(_CONFIG), **flags)


def given_settings(**flags: object) -> Settings:
    """As `traced_settings`, the settings alone."""
    return traced_settings(**flags).settings


def existing_data_dir(data_dir: Path) -> Path:
    """The folder itself, where it holds a catalog: a question must not make the folder it asks about.

    Raises:
        UnknownDomainError: It holds none.
    """
    if not catalog_path(data_dir).is_file():
        raise UnknownDomainError(
            f"there are no domains in {data_dir}: name their folder with --data-dir, or make one with `deepsimbad map`"
        )
    return data_dir


def _evaluator(_context: click.Context, _parameter: click.Parameter, value: str) -> EvaluatorConfig:
    kind, _, extractor = value.partition(":")
    if not extractor and (remark := fallback()) is not None:
        click.echo(remark, err=True)
    return evaluator_config({"kind": kind, **({"extractor": extractor} if extractor else {})})


def _evaluators(context: click.Context, parameter: click.Parameter, value: str) -> tuple[EvaluatorConfig, ...]:
    if value != "all":
        return (_evaluator(context, parameter, value),)
    pulled = Lock.read(given_settings().weights_dir).extractors()
    extractors = dict.fromkeys([default_extractor().value, ExtractorName.GRADIENT_GRID.value, *pulled])
    return tuple(evaluator_config({"kind": EvaluatorKind.FEATURE_L2.value, "extractor": name}) for name in extractors)


_NAMES = ", ".join(f"{EvaluatorKind.FEATURE_L2}:{extractor}" for extractor in EXTRACTOR_FORMS)
evaluator_option = click.option(  # given on as an EvaluatorConfig
    "--evaluator",
    default=EvaluatorKind.FEATURE_L2.value,
    show_default=True,
    callback=_evaluator,
    help=f"How images are compared with landmarks: a kind, or one of {_NAMES}.",
)
evaluators_option = click.option(  # or `all`; given on as EvaluatorConfigs
    "--evaluator",
    "evaluators",
    default=EvaluatorKind.FEATURE_L2.value,
    show_default=True,
    callback=_evaluators,
    help="How images are compared with landmarks: as KIND or KIND:EXTRACTOR; all: by every extractor that is here.",
)
