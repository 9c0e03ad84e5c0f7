"""Tables on standard output, never cut, however narrow the terminal is."""

import os

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

PIPE_COLUMNS = 160
_UNBOUNDED = 100_000  # columns, for a table's natural width


def print_whole(table: Table, console: Console) -> None:
    """Print a table; one too wide is printed with a line for each cell, since rich would cut names and drop columns."""
    if table.title and not table.row_count:
        console.print(f"{table.title}: none")
        return
    width = Measurement.get(console, console.options.update(max_width=_UNBOUNDED), table).maximum
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PIPE_COLUMNS
    console.print(table if width <= console.width or not table.show_header else _cell_lines(table))


def _cell_lines(table: Table) -> Table:
    lines = Table.grid(padding=(0, 2))
    lines.title, lines.title_justify, lines.caption, lines.caption_justify = table.title, "left", table.caption, "left"
    lines.add_column(style="dim")
    lines.add_column(overflow="fold")
    headings = [column.header for column in table.columns]
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        if lines.row_count:
            lines.add_row()
        for heading, cell in zip(headings, cells, strict=True):
            lines.add_row(heading, cell)
    return lines
