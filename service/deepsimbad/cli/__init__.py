"""The `deepsimbad` command (design section 7).

Exit codes: 0 done, 1 a named error (one line on standard error, `deepsimbad: CODE: MESSAGE`), 2 usage, 130 cancelled.
"""

import logging
import sys
from collections import UserDict
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper
from typing import Any

import click

from deepsimbad.errors import CancelledError, DeepSimbadError, UnavailableError
from deepsimbad_client.errors import DeepSimbadClientError

_FAILED, _CANCELLED = 1, 130
_COMMAND_PLACES = {  # module:attribute
    "experiment": "paper:experiment",
    "ray": "ray:ray",
    "try": "trial:try_",
    "weights": "weights:weights",
    **{name: f"serve:{name}" for name in ("init", "keys", "serve", "settings")},
    **{name: f"storage:{name}" for name in ("backup", "check", "export", "restore")},
    **{name: f"local:{name}" for name in ("info", "localize")},
    "delete-domain": "local:delete_domain",
    "import": "storage:import_",
    "map": "local:map_",
}


class _LazyCommands(UserDict[str, Any]):
    """Commands, each imported when it is asked for: most take half a second of imports that others do without."""

    def __getitem__(self, name: str) -> click.Command:
        module, _, attribute = self.data[name].partition(":")
        command: click.Command = getattr(import_module(f"{__name__}.{module}"), attribute)
        return command


@click.group(commands=_LazyCommands(_COMMAND_PLACES), context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="deep-simbad", message="%(version)s")
def deepsimbad() -> None:
    """Where on a known route a robot is, and which move would tell it most next."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    # Only `serve` writes a log; elsewhere an error is one line, without the trace that a library logs beside it.
    logging.getLogger("deepsimbad").addHandler(logging.NullHandler())
    if isinstance(sys.stdout, TextIOWrapper):  # as standard error does: a name that it cannot show ends no command
        sys.stdout.reconfigure(errors="backslashreplace")
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
