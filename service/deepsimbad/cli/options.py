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
from deepsimbad.settings import Settings
from deepsimbad.settings_sources import TracedSettings, trace_settings
from deepsimbad.store.layout import catalog_path

_Command = TypeVar("_Command", bound=Callable[..., Any])

_CONFIG = "deepsimbad.config"

RELEVANCES = click.Choice([relevance.value for relevance in Relevance])


def data_dir_option(command: _Command) -> _Command:
    """`--data-dir`, else as settings say, else ./deepsimbad-data; with `--config`."""
    return click.option(
        "--data-dir",
        type=click.Path(file_okay=False, path_type=Path),
        help="Folder of domains and maps.  [default: $DEEPSIMBAD_DATA_DIR, else ./deepsimbad-data]",
    )(config_option(command))


def config_option(command: _Command) -> _Command:
    """`--config FILE`, which `given_settings` reads."""
    return click.option(
        "--config",
        type=click.Path(path_type=Path),
        expose_value=False,
        callback=_remember_config,
        help="TOML file of settings.  [default: $DEEPSIMBAD_CONFIG, else ./deepsimbad.toml if it is there]",
    )(command)


def address_options(command: _Command) -> _Command:
    """`--host` and `--port`."""
    host = click.option("--host", help="Address to listen on.  [default: $DEEPSIMBAD_HOST, else 127.0.0.1]")
    port = click.option(
        "--port", type=int, help="Port to listen on; 0 takes a free one.  [default: $DEEPSIMBAD_PORT, else 8000]"
    )
    return host(port(command))


def given_settings(**flags: object) -> Settings:
    """The settings of the command that runs: its flags, the environment, the settings file, the defaults.

    Args:
        **flags: Settings by name; None counts as not given.

    Raises:
        SettingsError: The file cannot be read, a name is unknown or a value cannot be used.
    """
    return traced_settings(**flags).settings


def traced_settings(**flags: object) -> TracedSettings:
    """As `given_settings`, with the origin of every setting."""
    return trace_settings(click.get_current_context().meta.get(_CONFIG), **flags)


def evaluator_option(command: _Command) -> _Command:
    """`--evaluator KIND[:EXTRACTOR]`, given on as an EvaluatorConfig."""
    names = ", ".join(f"{EvaluatorKind.FEATURE_L2}:{extractor}" for extractor in EXTRACTOR_FORMS)
    return click.option(
        "--evaluator",
        default=EvaluatorKind.FEATURE_L2.value,
        show_default=True,
        callback=_evaluator,
        help=f"How images are compared with landmarks: a kind, or one of {names}.",
    )(command)


def evaluators_option(command: _Command) -> _Command:
    """As `evaluator_option`, or `all`, given on as EvaluatorConfigs."""
    return click.option(
        "--evaluator",
        "evaluators",
        default=EvaluatorKind.FEATURE_L2.value,
        show_default=True,
        callback=_evaluators,
        help="How images are compared with landmarks: as KIND or KIND:EXTRACTOR; all: by every extractor that is here.",
    )(command)


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


def spacing_option(command: _Command) -> _Command:
    """`--spacing-m` for sources without positions."""
    return click.option(
        "--spacing-m",
        type=click.FloatRange(min=0, min_open=True),
        default=1.0,
        show_default=True,
        help="Metres between frames of a source without positions.",
    )(command)


def _remember_config(context: click.Context, _parameter: click.Parameter, value: Path | None) -> None:
    context.meta[_CONFIG] = value


def _evaluators(context: click.Context, parameter: click.Parameter, value: str) -> tuple[EvaluatorConfig, ...]:
    if value != "all":
        return (_evaluator(context, parameter, value),)
    default, plain = default_extractor().value, ExtractorName.GRADIENT_GRID.value
    pulled = Lock.read(given_settings().weights_dir).extractors()
    return tuple(
        evaluator_config({"kind": EvaluatorKind.FEATURE_L2.value, "extractor": extractor})
        for extractor in dict.fromkeys([default, plain, *pulled])
    )


def _evaluator(_context: click.Context, _parameter: click.Parameter, value: str) -> EvaluatorConfig:
    kind, _, extractor = value.partition(":")
    if not extractor and (told := fallback()) is not None:
        click.echo(told, err=True)
    return evaluator_config({"kind": kind, **({"extractor": extractor} if extractor else {})})
