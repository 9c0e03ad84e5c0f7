"""What the commands share: options and settings that come in; progress, tables, JSON and pages that go out."""

import json
import math
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import CancelledError, UnavailableError, UnknownDomainError
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
from deepsimbad.jobs.progress import Progress, ProgressState
from deepsimbad.settings import Settings, TracedSettings, trace_settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.layout import catalog_path
from deepsimbad.store.shared_catalog import open_catalog
from deepsimbad_client.tables import print_whole

Command = TypeVar("Command", bound=Callable[..., Any])

FRAMES_A_SECOND = 150.0  # encoded, by which the stages of a bar are weighed
RELEVANCES = click.Choice([relevance.value for relevance in Relevance])
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
json_list_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON list.")
spacing_option = click.option(
    "--spacing-m",
    type=click.FloatRange(min=0, min_open=True),
    default=1.0,
    show_default=True,
    help="Metres between frames of a source without positions.",
)


def remember(context: click.Context, parameter: click.Parameter, value: object) -> None:
    """Click's callback of an option that is a setting: keeps its value for `given_settings`."""
    context.meta[f"deepsimbad.{parameter.name}"] = value


config_option = click.option(
    "--config",
    type=click.Path(path_type=Path),
    expose_value=False,
    callback=remember,
    help="TOML file of settings.  [default: $DEEPSIMBAD_CONFIG, else ./deepsimbad.toml if it is there]",
)


def folder_option(
    flag: str, help_text: str, callback: Callable[..., object] | None = remember
) -> Callable[[Command], Command]:
    """An option of a folder that settings name too."""
    folder = click.Path(file_okay=False, path_type=Path)
    return click.option(flag, type=folder, expose_value=False, callback=callback, help=help_text)


def data_dir_option(command: Command) -> Command:
    """`--data-dir`, else as settings say, else ./deepsimbad-data; with `--config`."""
    help_text = "Folder of domains and maps.  [default: $DEEPSIMBAD_DATA_DIR, else ./deepsimbad-data]"
    return folder_option("--data-dir", help_text)(config_option(command))


def traced_settings(**flags: object) -> TracedSettings:
    """The settings of the command that runs, each with its origin: flags, environment, settings file, defaults.

    Args:
        **flags: Settings by name, beside those remembered; None counts as not given.

    Raises:
        SettingsError: The file cannot be read, a name is unknown or a value cannot be used.
    """
    meta = click.get_current_context().meta
    flags |= {name: meta.get(f"deepsimbad.{name}") for name in ("data_dir", "weights_dir", "map_store")}
    return trace_settings(meta.get("deepsimbad.config"), **flags)


def given_settings(**flags: object) -> Settings:
    """The settings of the command that runs, as `traced_settings`."""
    return traced_settings(**flags).settings


def existing_data_dir() -> Path:
    """The data directory, where it holds a catalog: a question must not make the folder it asks about.

    Raises UnknownDomainError: it holds none.
    """
    data_dir = given_settings().data_dir
    if not catalog_path(data_dir).is_file():
        raise UnknownDomainError(
            f"there are no domains in {data_dir}: name their folder with --data-dir, or make one with `deepsimbad map`"
        )
    return data_dir


def open_given_catalog() -> Catalog:
    """The catalog of the data directory, which follows a map store where settings say so or it did before."""
    settings = given_settings()
    catalog = open_catalog(settings.data_dir, settings.map_store, settings.map_cache_disk_bytes)
    try:
        catalog.catch_up()
    except UnavailableError as error:  # what is here can be asked
        click.echo(f"what others published since is not known: {error.message}", err=True)
    return catalog


map_store_option = click.option(
    "--map-store",
    metavar="URL",
    expose_value=False,
    callback=remember,
    help="Objects by which machines share maps, as s3://bucket/prefix or file:///folder.  [default: as before]",
)


def _evaluator(_context: click.Context, _parameter: click.Parameter, value: str) -> EvaluatorConfig:
    halves = [
        {"kind": kind, **({"extractor": extractor} if extractor else {})}
        for kind, _, extractor in (half.partition(":") for half in value.split("+"))
    ]
    takes_default = any(half["kind"] in _OF_IMAGES and "extractor" not in half for half in halves)
    if takes_default and (remark := fallback()) is not None:
        click.echo(remark, err=True)
    return evaluator_config(halves[0] if len(halves) == 1 else {"kind": EvaluatorKind.FUSED.value, "of": halves})


def _evaluators(context: click.Context, parameter: click.Parameter, value: str) -> tuple[EvaluatorConfig, ...]:
    if value != "all":
        return (_evaluator(context, parameter, value),)
    pulled_names = Lock.read(given_settings().weights_dir).extractors()
    extractors = dict.fromkeys([default_extractor().value, ExtractorName.GRADIENT_GRID.value, *pulled_names])
    return tuple(evaluator_config({"kind": EvaluatorKind.FEATURE_L2.value, "extractor": name}) for name in extractors)


_OF_IMAGES = {EvaluatorKind.FEATURE_L2, EvaluatorKind.SIAMESE, EvaluatorKind.AUTOENCODER}
_KINDS = ", ".join(kind for kind in EvaluatorKind if kind is not EvaluatorKind.FUSED)
_NAMES = (
    f"{_KINDS}, alone or with a colon and an extractor: {', '.join(EXTRACTOR_FORMS)}; or two with a plus that are "
    "fused: feature_l2+objects"
)
evaluator_option = click.option(  # given on as an EvaluatorConfig
    "--evaluator",
    default=EvaluatorKind.FEATURE_L2.value,
    show_default=True,
    callback=_evaluator,
    help=f"How images are compared with landmarks: a kind of {_NAMES}.",
)
evaluators_option = click.option(  # or `all`; given on as EvaluatorConfigs
    "--evaluator",
    "evaluators",
    default=EvaluatorKind.FEATURE_L2.value,
    show_default=True,
    callback=_evaluators,
    help="How images are compared with landmarks: as KIND or KIND:EXTRACTOR; all: by every extractor that is here.",
)


def progress_bars(done_column: ProgressColumn) -> Bars:
    """Bars on standard error; where that is no terminal, a log keeps an error's one line, and no blank ones."""
    errors = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), done_column, TimeRemainingColumn())
    return Bars(*columns, console=errors, transient=True, disable=not errors.is_interactive)


@contextmanager
def progress_bar(stages: Mapping[str, float], title: str, *, cancel_note: str = "") -> Iterator[Progress]:
    """A progress bar over weighted stages; Ctrl-C cancels at the next report, with `cancel_note` in the message."""
    is_interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal is_interrupted
        is_interrupted = True

    bars = progress_bars(TaskProgressColumn())
    task = bars.add_task(title, total=1.0)

    def show(state: ProgressState) -> None:
        bars.update(task, completed=state.progress, description=f"{title}: {state.stage}")

    old_handler = signal.signal(signal.SIGINT, interrupt)
    try:
        with bars:
            yield Progress(stages, show, lambda: is_interrupted)
    except CancelledError as error:
        raise CancelledError(f"{error}{cancel_note}") from error
    finally:
        signal.signal(signal.SIGINT, old_handler)


def print_table(table: Table, *remarks: str, numbers: bool = False) -> None:
    """Print a table on standard output, and remarks in lines below it."""
    for column in table.columns[1:] if numbers else ():  # the first holds names
        column.justify = "right"
    console = Console()
    print_whole(table, console)
    for remark in remarks:
        console.print(remark)


def report(as_json: bool, document: Any, line: str) -> None:
    """Report what was done: one JSON document for a script, or one line on standard error for a person."""
    if as_json:
        write_json(document)
    else:
        click.echo(line, err=True)


def write_json(document: Any, file: Path | None = None) -> None:
    """Write one JSON document, on standard output or in a file; numbers that JSON lacks become null."""
    text = json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False)
    if file is None:
        click.echo(text)
    else:  # of a file's name that is not UTF-8, what standard error shows of it, which JSON reads as the same name
        file.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def render(file: Path, template: str, **values: Any) -> Path:
    """Write a template beside this file; a page has everything in it, no script, both colour themes."""
    templates = Environment(
        loader=PackageLoader("deepsimbad.cli", "."),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(templates.get_template(template).render(**values), encoding="utf-8", errors="backslashreplace")
    return file
