"""Run every benchmark and write docs/results/bench.md."""

from collections.abc import Iterator

from bench.answering import retrieval_table, step_table
from bench.building import composed_table, landmark_table, map_file_table, nnql_table
from bench.common import machine, write_page
from bench.index_size import index_table
from bench.remap import remap_table
from bench.serving import http_table, restart_table, session_table

TABLES = (
    retrieval_table,
    landmark_table,
    index_table,
    map_file_table,
    composed_table,
    nnql_table,
    step_table,
    http_table,
    session_table,
    restart_table,
    remap_table,
)


def lines() -> Iterator[str]:
    """The page."""
    yield from ("# Benchmarks", "", "Made by `make bench`. Medians; machines are shared and noisy.", "", machine())
    for table in TABLES:
        yield ""
        yield from table()


if __name__ == "__main__":
    write_page("bench.md", lines())
