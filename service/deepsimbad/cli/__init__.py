"""The `deepsimbad` command (design section 7).

Exit codes: 0 done, 1 a named error (one line on standard error, `deepsimbad: CODE: MESSAGE`), 2 usage, 130 cancelled.
"""

import logging
from collections.abc import Sequence

import click

from deepsimbad.cli.experiment import experiment
from deepsimbad.cli.local import delete_domain, info, localize, map_
from deepsimbad.cli.paper import paper
from deepsimbad.cli.ray import ray
from deepsimbad.cli.serve import init, keys, serve, settings
from deepsimbad.cli.storage import backup, check, export, import_, restore
from deepsimbad.cli.trial import try_
from deepsimbad.cli.weights import weights
from deepsimbad.errors import CancelledError, DeepSimbadError, UnavailableError
from deepsimbad_client.errors import DeepSimbadClientError

_FAILED, _CANCELLED = 1, 130


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="deep-simbad", message="%(version)s")
def deepsimbad() -> None:
    """Where on a known route a robot is, and which move would tell it most next."""


for command in (
    *(init, serve, map_, localize, try_, info, delete_domain, experiment, keys, settings),
    *(backup, restore, export, import_, check, weights, ray),
):
    deepsimbad.add_command(command)
experiment.add_command(paper)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    # Only `serve` writes a log; elsewhere an error is one line, without the trace that a library logs beside it.
    logging.getLogger("deepsimbad").addHandler(logging.NullHandler())
    try:
        code = deepsimbad.main(args=None if arguments is None else list(arguments), standalone_mode=False)
    except CancelledError as error:
        click.echo(error.message, err=True)
        return _CANCELLED
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo("cancelled", err=True)
        return _CANCELLED
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (DeepSimbadError, DeepSimbadClientError) as error:
        return _failed(error.code, error)
    except OSError as error:
        return _failed(UnavailableError.code, error)
    return code if isinstance(code, int) else 0  # what a command exits with, where it says so


def _failed(code: str, error: Exception) -> int:
    click.echo(f"deepsimbad: {code}: {' '.join(str(error).split())}", err=True)
    return _FAILED
