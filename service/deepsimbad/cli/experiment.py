"""`deepsimbad experiment`: the paper's experiments on a landmark-training-test triplet of recordings."""

import click

from deepsimbad.cli.nbv import nbv
from deepsimbad.cli.vpr import vpr


@click.group()
def experiment() -> None:
    """Measure: the paper's tables on your recordings."""


experiment.add_command(vpr)
experiment.add_command(nbv)
