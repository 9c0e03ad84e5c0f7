"""`deepsimbad serve`."""

from pathlib import Path

import click

from deepsimbad.cli.options import data_dir_option


@click.command()
@data_dir_option
@click.option("--host", help="Address to listen on.  [default: $DEEPSIMBAD_HOST, else 127.0.0.1]")
@click.option("--port", type=int, help="Port to listen on; 0 takes a free one.  [default: $DEEPSIMBAD_PORT, else 8000]")
def serve(data_dir: Path | None, host: str | None, port: int | None) -> None:
    """Serve the domains over HTTP until interrupted. Ready when /readyz answers 200."""
    from deepsimbad.api.server import serve as serve_until_stopped  # noqa: PLC0415 - other commands need no server
    from deepsimbad.settings import load_settings  # noqa: PLC0415

    serve_until_stopped(load_settings(data_dir=data_dir, host=host, port=port))
