"""Run every benchmark and write docs/results/bench.md, or print some: python -m bench [index session ...]."""

from collections.abc import Iterable, Iterator, Sequence

from bench.answering import retrieval_table, step_table
from bench.building import composed_table, landmark_table, map_file_table, nnql_table
from bench.index_size import index_table
from bench.measurement import RESULTS, Command, machine, one_of, print_page
from bench.remap import remap_table
from bench.serving import http_table, restart_table, session_table

TABLES = {
    "retrieval": retrieval_table,
    "landmarks": landmark_table,
    "index": index_table,
    "file": map_file_table,
    "lists": composed_table,
    "nnql": nnql_table,
    "step": step_table,
    "http": http_table,
    "session": session_table,
    "restart": restart_table,
    "remap": remap_table,
}


def lines(names: Iterable[str] = TABLES) -> Iterator[str]:
    """The page, with these tables."""
    yield from ("# Benchmarks", "", "Made by `make bench`. Medians; machines are shared and noisy.", "", machine())
    for name in names:
        yield ""
        yield from TABLES[name]()


def measure(tables: Sequence[str]) -> None:
    """Print these tables; none: write the page of all."""
    print_page(lines(tables or TABLES), None if tables else RESULTS / "bench.md")


if __name__ == "__main__":
    command = Command(__doc__)
    command.add_argument("tables", nargs="*", type=one_of(TABLES), metavar="TABLE", help=", ".join(TABLES))
    command.run(lambda arguments: measure(arguments.tables))
