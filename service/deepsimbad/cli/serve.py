"""`deepsimbad serve`."""

import logging
from pathlib import Path

import click

from deepsimbad.cli.options import address_options, data_dir_option, given_settings
from deepsimbad.errors import DeepSimbadError
from deepsimbad.settings_sources import unknown_variables

log = logging.getLogger(__name__)


@click.command()
@data_dir_option
@address_options
def serve(data_dir: Path | None, host: str | None, port: int | None) -> None:
    """Serve the domains over HTTP until interrupted. Ready when /readyz answers 200."""
    from deepsimbad.api.logs import configure_logging  # noqa: PLC0415 - other commands need no server
    from deepsimbad.api.native_lines import native_lines_in_the_log  # noqa: PLC0415
    from deepsimbad.api.server import serve as serve_until_stopped  # noqa: PLC0415

    with native_lines_in_the_log():
        try:
            settings = given_settings(data_dir=data_dir, host=host, port=port)
            configure_logging(settings.log_level)
            for variable in unknown_variables():
                log.warning("set in the environment, and no setting", extra={"variable": variable})
            serve_until_stopped(settings)
        except DeepSimbadError as error:
            configure_logging("ERROR")  # the settings themselves may be what is wrong
            log.error("cannot start", extra={"code": error.code, "why": error.message})
            raise
