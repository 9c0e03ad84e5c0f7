"""`deepsimbad experiment nbv`."""

from pathlib import Path

import click
from rich.table import Table

from deepsimbad.cli.options import RELEVANCES, evaluator_option
from deepsimbad.cli.terminal import console, progress_bar
from deepsimbad.cli.triplet import READING_STAGES, read_triplet, triplet_options, written
from deepsimbad.core.planners import DEFAULT_PLANNER
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.core.update_rules import DEFAULT_UPDATE, UpdateRule
from deepsimbad.evaluators.registry import EvaluatorConfig
from deepsimbad.jobs.experiment_nbv import NbvConfig, NbvReport, nbv_stages, run_nbv
from deepsimbad.jobs.map_config import DEFAULT_TRAINING_EPISODES


@click.command()
@triplet_options
@evaluator_option
@click.option("--relevance", type=RELEVANCES, help=f"Of our set-up.  [default: {DEFAULT_RELEVANCE.value}]")
@click.option(
    "--update",
    type=click.Choice([rule.value for rule in UpdateRule]),
    help="How a view changes the belief.  [default: as suits the relevance]",
)
@click.option("--training-episodes", type=click.IntRange(min=0), default=DEFAULT_TRAINING_EPISODES, show_default=True)
@click.option(
    "--episodes", type=click.IntRange(min=2), default=2000, show_default=True, help="Test episodes of every planner."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
def nbv(
    landmarks: str,
    training: str,
    test: str,
    evaluator: EvaluatorConfig,
    spacing_m: float,
    n_landmarks: int,
    list_length: int,
    same_route: bool | None,
    json_file: Path | None,
    relevance: str | None,
    update: str | None,
    training_episodes: int,
    episodes: int,
    seed: int,
) -> None:
    """Active self-localization (III, Fig. 7): ANR of every planner over episodes of ten moves.

    Every planner has the same starts. The paper's set-up (rrf, additive relevance) is measured beside ours.
    """
    chosen = Relevance(relevance) if relevance else DEFAULT_RELEVANCE
    config = NbvConfig(
        n_landmarks=n_landmarks,
        list_length=list_length,
        relevance=chosen,
        update=UpdateRule(update) if update else DEFAULT_UPDATE[chosen],
        training_episodes=training_episodes,
        episodes=episodes,
        seed=seed,
        same_route=same_route is not False,
    )
    with progress_bar(READING_STAGES | nbv_stages(config), "experiment") as progress:
        triplet = read_triplet(landmarks, training, test, evaluator, spacing_m, progress)
        report = run_nbv(config, triplet.evaluator, triplet.landmarks, triplet.training, triplet.test, progress)
    if not written(report.as_dict(triplet.sources), json_file):
        _print_table(report)


def _print_table(report: NbvReport) -> None:
    document = report.as_dict({})
    table = Table("planner", "ANR %", "95 %", "ANR % as in the paper", *_distances(document))
    for name, anr in sorted(document["anr"].items(), key=lambda item: float(item[1])):
        low, high = document["interval_95"][name]
        at = document["anr_at_distance_m"][name]
        table.add_row(
            f"{name} (default)" if name == DEFAULT_PLANNER else name,
            f"{anr:.3f}",
            f"{low:.3f} .. {high:.3f}",
            f"{document['anr_paper'][name]:.2f}",
            *("-" if value is None else f"{value:.2f}" for value in at.values()),
        )
    for column in table.columns[1:]:
        column.justify = "right"
    output = console()
    output.print(table)
    for pair, (low, high) in document["difference_95"].items():
        output.print(f"{pair}: {low:+.3f} .. {high:+.3f} % (paired, 95 %)")
    if report.same_route is not None and report.same_route.why is not None:
        output.print(f"no second season was learnt from: {report.same_route.why}")


def _distances(document: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    first = next(iter(document["anr_at_distance_m"].values()))
    return [f"after {distance_m} m" for distance_m in first]
