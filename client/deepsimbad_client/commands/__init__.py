"""The commands of `deepsimbad-client`, and the exit codes of their errors.

Exit codes: 0 done, 1 a named error (one line on standard error), 2 wrong usage, 130 cancelled. Results go to standard
output, progress and remarks to standard error.
"""

import os
import sys
from collections.abc import Sequence
from io import TextIOWrapper

import click

from deepsimbad_campus.__main__ import campus_command
from deepsimbad_client.commands import admin, recordings
from deepsimbad_client.commands.console import show_waits
from deepsimbad_client.errors import DeepSimbadClientError, NotSavedError

DONE, FAILED, CANCELLED = 0, 1, 130
RESUMABLE = {"upload", "replay", "download", "campus"}
GOES_ON = "; the same command goes on where it stopped"


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="deep-simbad", message="%(version)s")
def cli() -> None:
    """Send recordings to a Deep SIMBAD service, map them, and see how well it localizes.

    SOURCE is nclt:ROOT/DATE, a folder of images in name order (with an optional positions.csv), rosbag:FILE[#topic], a
    video, or a .npy or .csv of ready encodings; it may end in #START:STOP[:STEP], Python's slice of its frames.
    """


COMMANDS = (
    recordings.upload,
    recordings.localize,
    recordings.replay,
    recordings.watch,
    admin.remap,
    admin.jobs,
    admin.domains,
    admin.traverses,
    admin.sessions,
    admin.maps,
    admin.activate,
    admin.rollback,
    admin.download,
    admin.delete_domain,
    admin.delete_traverse,
    admin.delete_map,
    admin.delete_session,
    campus_command,
)
for command in COMMANDS:
    cli.add_command(command)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default that of the process; returns its exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    show_waits()
    if isinstance(sys.stdout, TextIOWrapper):  # as standard error does: a name that it cannot show ends no command
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = cli.main(words, prog_name="deepsimbad-client", standalone_mode=False)
    except DeepSimbadClientError as error:
        one_line = " ".join(str(error).split())
        sys.stderr.write(f"deepsimbad-client: {error.code}: {one_line}\n")
        return FAILED
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        sys.stderr.write(f"deepsimbad-client: cancelled{GOES_ON if RESUMABLE.intersection(words[:1]) else ''}\n")
        return CANCELLED
    except BrokenPipeError:  # the reader of the output has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except OSError as error:
        sys.stderr.write(f"deepsimbad-client: {NotSavedError.code}: {error}\n")
        return FAILED
    return code if isinstance(code, int) else DONE
