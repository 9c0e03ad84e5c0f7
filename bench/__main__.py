"""Run every benchmark and write docs/results/bench.md."""

import sys
from pathlib import Path

from bench.answering import retrieval_table, step_table
from bench.building import landmark_table, map_file_table, nnql_table
from bench.common import describe
from bench.remap import remap_table
from bench.serving import http_table, restart_table, session_table

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results" / "bench.md"

TABLES = (
    retrieval_table,
    landmark_table,
    map_file_table,
    nnql_table,
    step_table,
    http_table,
    session_table,
    restart_table,
    remap_table,
)


def main() -> None:
    """Print the tables as they are measured, then write them."""
    lines = ["# Benchmarks", "", "Made by `make bench`. Medians; machines are shared and noisy.", ""]
    lines += [f"Machine: {describe()}", ""]
    for table in TABLES:
        for line in table():
            print(line, flush=True)
            lines.append(line)
        lines.append("")
    RESULTS.write_text("\n".join(lines), encoding="utf-8")
    print(f"\nwritten to {RESULTS}", file=sys.stderr)


if __name__ == "__main__":
    main()
