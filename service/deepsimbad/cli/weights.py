"""`deepsimbad weights`: which weights are known, bringing them here, and whether they are still what came."""

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import click
from rich.markup import escape
from rich.progress import DownloadColumn, TaskID
from rich.table import Column, Table

from deepsimbad.cli.terminal import (
    Command,
    data_dir_option,
    folder_option,
    given_settings,
    json_list_option,
    json_option,
    print_table,
    progress_bars,
    write_json,
)
from deepsimbad.errors import InvalidInputError, MissingWeightsError
from deepsimbad.evaluators.registry import EXTRACTOR_FORMS, EXTRACTOR_PATTERN
from deepsimbad.evaluators.weights.downloads import HubWish, Tell, pull_file, pull_hub
from deepsimbad.evaluators.weights.library import HUB, KNOWN, Argument, canonical, known_weights
from deepsimbad.evaluators.weights.lock import HUB_FOLDER, Lock

_SHA256 = re.compile(r"[0-9a-fA-F]{8,64}")
_COMMIT = re.compile(r"[0-9a-f]{40}")
_SIZE = re.compile(r"([1-9]\d{0,3})x([1-9]\d{0,3})")


def _folder_options(command: Command) -> Command:
    """`--weights-dir`, beside the options that every command takes."""
    help_text = "Folder of weights.  [default: $DEEPSIMBAD_WEIGHTS_DIR, else ~/.cache/deepsimbad/weights]"
    return folder_option("--weights-dir", help_text)(data_dir_option(command))


@click.group()
def weights() -> None:
    """Weights of networks. Nothing is downloaded but by `pull`, and what was pulled is held to its digests."""


@weights.command("list")
@json_list_option
@_folder_options
def list_(as_json: bool) -> None:
    """List the weights that are known, and what else was pulled, with how a configuration names them."""
    lock = Lock.read(given_settings().weights_dir)
    rows = list(_rows(lock))
    if as_json:
        write_json(rows)
        return
    titles = ("name", "extractor", "dimension", "input", "licence", "size", "here")
    table = Table(*(Column(title, overflow="fold") for title in titles))  # names are there to be copied
    for row in rows:
        size = None if row["size_mb"] is None else f"{row['size_mb']} MB"
        cells = (row["name"], row["extractor"], row["encoding_dim"], row["input"], row["licence"], size, row["state"])
        table.add_row(*("-" if cell is None else escape(str(cell)) for cell in cells))
    print_table(table)


@weights.command()
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@click.option("--url", help="Where the file is, if it is not a known one.")
@click.option("--sha256", help="Digest the file must have, or the repository's archive; its first 8 digits at least.")
@click.option("--commit", help="Commit of the repository, all 40 digits.  [default: as recorded, as known, the newest]")
@click.option("--argument", "arguments", multiple=True, metavar="KEY=VALUE", help="For the repository's entry.")
@click.option("--input-size", help="Pixels images are brought to, as 322x322 (width, height).")
@click.option("--yes", is_flag=True, help="Run the repository's code without asking.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON list of what was recorded.")
@_folder_options
def pull(names: tuple[str, ...], yes: bool, as_json: bool, **options: Any) -> None:
    """Bring weights here and record their digests. NAME is of `weights list`, or an extractor's, as netvlad:FILE.

    A download that broke off goes on where it stopped. Of a torch hub repository the archive at a commit is fetched and
    its code is run once, so that its own downloads come too: you are asked before.
    """
    folder = given_settings().weights_dir
    extractors = [_extractor(name) for name in names]
    hub = [extractor for extractor in extractors if extractor.startswith(HUB)]
    url, sha256, commit, arguments = (options[name] for name in ("url", "sha256", "commit", "arguments"))
    if len(names) > 1 and any(options.values()):
        raise click.UsageError("--url, --sha256, --commit, --argument and --input-size are for one NAME")
    _check_form("--sha256", sha256, _SHA256)
    _check_form("--commit", commit, _COMMIT)
    size = _check_form("--input-size", options["input_size"], _SIZE)
    if (url and hub) or ((commit or arguments or size) and len(hub) < len(names)):
        raise click.UsageError("--url is for files; --commit, --argument and --input-size are for torch hub")
    values, sides = dict(map(_argument, arguments)), (int(size[1]), int(size[2])) if size else None
    for extractor in hub:
        _agree(extractor, yes)
    rows = []
    for extractor in extractors:
        with _download_bar() as tell:
            if extractor in hub:
                tree = pull_hub(folder, HubWish(extractor, commit, sha256, values, sides), tell)
                digest, path = tree.tree_sha256, folder / HUB_FOLDER / tree.folder
            else:
                digest = pull_file(folder, extractor, tell, url, sha256).sha256
                path = folder / extractor.partition(":")[2]
        click.echo(f"{extractor} is at {path}, sha256 {digest}", err=True)
        rows.append({"extractor": extractor, "path": str(path), "sha256": digest})
    if as_json:
        write_json(rows)


@weights.command()
@click.argument("names", metavar="[NAME...]", nargs=-1)
@json_option
@_folder_options
@click.pass_context
def verify(context: click.Context, names: tuple[str, ...], as_json: bool) -> None:
    """Compute the digests of what was pulled anew: one line each, exit code 1 if one differs or is missing."""
    lock = Lock.read(given_settings().weights_dir)
    findings = [finding for name in _record_names(lock, names) for finding in lock.findings(name)]
    are_good = all(finding.is_good for finding in findings)
    if as_json:
        rows = [
            {"path": str(finding.path), "recorded": finding.recorded_sha256, "found": finding.sha256}
            for finding in findings
        ]
        write_json({"ok": are_good, "findings": rows})
    for finding in [] if as_json else findings:
        state = "good" if finding.is_good else "missing" if finding.sha256 is None else "differs"
        recorded_note = "" if finding.is_good else f" (recorded: {finding.recorded_sha256})"
        click.echo(f"{state}: {finding.path}: {finding.sha256 or 'not there'}{recorded_note}")
    if not are_good:
        context.exit(1)


def _extractor(name: str) -> str:
    """The extractor that a name means, as a configuration would name it."""
    entry = known_weights(name)
    extractor = name if entry is None else entry.extractor
    if entry is not None and entry.package is not None:
        raise InvalidInputError(f"{name} comes with the package {entry.package}: there is nothing to pull")
    if ":" not in extractor or re.fullmatch(EXTRACTOR_PATTERN, extractor) is None:
        forms = ", ".join(form for form in EXTRACTOR_FORMS if ":" in form)
        raise InvalidInputError(f"{name} is no name of `deepsimbad weights list`, and none of {forms}", name=name)
    return extractor


def _record_names(lock: Lock, names: tuple[str, ...]) -> Iterator[str]:
    """Yield the names of records in the lock; all of them where none is named."""
    if not names:
        yield from (*lock.files, *lock.hub)
    for name in names:
        extractor = _extractor(name)
        record = canonical(extractor) if extractor.startswith(HUB) else extractor.partition(":")[2]
        if record not in lock.hub and record not in lock.files:
            raise MissingWeightsError(f"{name} was never pulled to {lock.folder}: nothing is recorded of it", name=name)
        yield record


def _check_form(option: str, value: str | None, form: re.Pattern[str]) -> re.Match[str] | None:
    match = None if value is None else form.fullmatch(value)
    if value is not None and match is None:
        raise click.BadParameter(f"{value!r} is none", param_hint=option)
    return match


def _argument(text: str) -> tuple[str, Argument]:
    """A name and its value: a number, true, false or null, as JSON has them, else a text."""
    name, _, value = text.partition("=")
    if not name.isidentifier():
        raise click.BadParameter(f"{text!r} is not of the form KEY=VALUE", param_hint="--argument")
    try:
        number = json.loads(value)
    except ValueError:
        return name, value
    return name, number if isinstance(number, bool | int | float | None) else value


def _agree(extractor: str, yes: bool) -> None:
    """Have it confirmed that code of others will be run."""
    repository = extractor.removeprefix(HUB).partition(":")[0]
    warning = f"{extractor} runs the code of github.com/{repository} on this machine, now and whenever it is used"
    click.echo(warning, err=True)
    if not yes:
        if not sys.stdin.isatty():
            raise click.UsageError(f"{warning}: say --yes if you trust it")
        click.confirm("Do you trust it?", abort=True, err=True)


@contextmanager
def _download_bar() -> Iterator[Tell]:
    """A progress bar on standard error for every file that comes."""
    with progress_bars(DownloadColumn()) as bars:
        tasks: dict[str, TaskID] = {}

        def tell(name: str, n_bytes: int, n_in_all: int | None) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(escape(name), total=n_in_all)
            bars.update(tasks[name], completed=n_bytes, total=n_in_all)

        yield tell


def _rows(lock: Lock) -> Iterator[dict[str, Any]]:
    """The rows of `weights list`: weights that are known, then others that were pulled."""
    for weights_ in KNOWN:
        row = _row(lock, weights_.name, weights_.extractor)
        row |= {"licence": weights_.licence, "packages": list(weights_.packages), "page": weights_.page}
        row["encoding_dim"] = row["encoding_dim"] or weights_.encoding_dim
        row["input"] = row["input"] or _size_text(weights_.input_size)
        row["size_mb"] = row["size_mb"] or weights_.size_mb
        if weights_.package is not None:
            is_there = find_spec(weights_.package.replace("-", "_")) is not None
            row["state"] = "with its package" if is_there else "no package"
        yield row
    known_files = {weights_.file for weights_ in KNOWN}
    known_hub = {canonical(weights_.extractor) for weights_ in KNOWN}
    yield from (_row(lock, name, file.extractor) for name, file in lock.files.items() if name not in known_files)
    yield from (_row(lock, hub.repository, name) for name, hub in lock.hub.items() if name not in known_hub)


def _row(lock: Lock, name: str, extractor: str) -> dict[str, Any]:
    """A row by the lock and the folder alone; digests are for `verify`."""
    file_name = extractor.partition(":")[2]
    hub, file = lock.hub_record(extractor), None if extractor.startswith(HUB) else lock.files.get(file_name)
    if extractor.startswith(HUB):
        is_there = hub is not None and (lock.folder / HUB_FOLDER / hub.folder).exists()
    else:
        is_there = bool(file_name) and (lock.folder / file_name).exists()
    states = {(True, True): "pulled", (True, False): "missing", (False, True): "not recorded", (False, False): "-"}
    return {
        "name": name,
        "extractor": extractor,
        "encoding_dim": hub.encoding_dim if hub else None,
        "input": _size_text(hub.input_size) if hub else None,
        "licence": None,
        "size_mb": round(file.n_bytes / 1e6, 1) if file else None,
        "packages": [],
        "page": file.url if file else None,
        "state": states[bool(hub or file), is_there],
    }


def _size_text(size: tuple[int, int] | None) -> str:
    return "aspect kept" if size is None else f"{size[0]}x{size[1]}"
