"""A landmark-training-test triplet of recordings: the options that name it, and its reading."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

import click

from deepsimbad.cli.options import config_option, given_settings, spacing_option
from deepsimbad.cli.terminal import write_json
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.jobs.encoded_traverse import EncodedTraverse, encode_recording
from deepsimbad.jobs.progress import Progress
from deepsimbad_client.recordings.sources import open_source

READING_STAGES = {"read landmarks": 2.0, "read training": 2.0, "read test": 2.0}
STANDARD_OUTPUT = Path("-")

_Command = TypeVar("_Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class Triplet:
    """Three encoded recordings, and what measures them.

    Attributes:
        landmarks, training, test: The recordings.
        evaluator: Of all three.
        sources: What was read, for the result's `config`.
    """

    landmarks: EncodedTraverse
    training: EncodedTraverse
    test: EncodedTraverse
    evaluator: Evaluator
    sources: dict[str, Any]


def triplet_options(command: _Command) -> _Command:
    """The options that `read_triplet` takes, and those every experiment has."""
    options = (
        click.option("--landmarks", required=True, help="SOURCE landmarks are selected from."),
        click.option("--training", required=True, help="SOURCE that becomes the map."),
        click.option("--test", required=True, help="SOURCE of the live views, in the order they were driven."),
        spacing_option,
        click.option("--n-landmarks", type=click.IntRange(min=1), default=300, show_default=True),
        click.option("--list-length", type=click.IntRange(min=1), default=4, show_default=True),
        click.option(
            "--same-route/--no-same-route",
            default=None,
            help="Whether landmarks and training count their positions along one route, as test and training do.  "
            "[default: they do]",
        ),
        click.option(
            "--json",
            "json_file",
            type=click.Path(dir_okay=False, path_type=Path),
            is_flag=False,
            flag_value=STANDARD_OUTPUT,
            help="Write the result as JSON to FILE; without FILE to standard output.",
        ),
        config_option,
        click.option(  # as every command does, so that a script may give it to all of them
            "--data-dir",
            type=click.Path(file_okay=False, path_type=Path),
            expose_value=False,
            help="Taken as by every command; an experiment reads and keeps nothing there.",
        ),
    )
    return reduce(lambda decorated, option: option(decorated), reversed(options), command)


def read_triplet(
    landmarks: str, training: str, test: str, evaluator: EvaluatorConfig, spacing_m: float, progress: Progress
) -> Triplet:
    """Read and encode the three recordings; reports READING_STAGES."""
    settings = given_settings()
    judge = make_evaluator(evaluator, settings.compute())
    traverses = []
    for stage, source in zip(READING_STAGES, (landmarks, training, test), strict=True):
        progress.stage(stage)
        recording = open_source(source, spacing_m=spacing_m)
        traverses.append(encode_recording(recording, judge, settings.max_pixels, progress.update))
    roles = ("landmarks", "training", "test")
    sources = {
        **dict(zip(roles, (landmarks, training, test), strict=True)),
        "evaluator": evaluator.as_dict(),
        "spacing_m": spacing_m,
        "left_out": {role: traverse.left_out for role, traverse in zip(roles, traverses, strict=True)},
    }
    first, second, third = traverses
    return Triplet(first, second, third, judge, sources)


def written(document: dict[str, Any], json_file: Path | None) -> bool:
    """Write a result where `--json` says; whether that was standard output, which then holds nothing else."""
    if json_file == STANDARD_OUTPUT:
        write_json(document)
        return True
    if json_file is not None:
        write_json(document, json_file)
    return False
