import sqlite3
from pathlib import Path

import pytest

from deepsimbad.errors import DamagedMapError
from deepsimbad.store.pages import fitting_page_size, walked_sizes


@pytest.mark.parametrize("page_size", [512, 4096, 65536])
def test_walking_the_trees_counts_what_dbstat_counts(page_size: int, tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    connection = sqlite3.connect(path)
    try:
        connection.execute("SELECT 1 FROM dbstat")
    except sqlite3.OperationalError:
        pytest.skip("this SQLite has no dbstat to compare with")
    connection.execute(f"PRAGMA page_size = {page_size}")
    connection.execute("CREATE TABLE small (a)")
    connection.execute("CREATE TABLE rows (a INTEGER PRIMARY KEY, b BLOB)")
    connection.execute("CREATE TABLE keyed (a, b, c BLOB, PRIMARY KEY (a, b)) WITHOUT ROWID")
    connection.execute("CREATE INDEX by_b ON rows (b)")
    for n in range(300):
        body = bytes((n * n) % (9 * page_size // 4) + n % 7)
        connection.execute("INSERT INTO rows VALUES (?, ?)", [n, body])
        connection.execute("INSERT INTO keyed VALUES (?, ?, ?)", [n // 3, n % 3, body])
    connection.commit()
    expected = connection.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name").fetchall()
    walked = dict(walked_sizes(connection, path))
    names = {"sqlite_master": "sqlite_schema"}
    assert walked == {names.get(name, name): size for name, size in expected}
    assert walked["keyed"] > 10 * page_size
    half = tmp_path / "half"
    half.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DamagedMapError):
        walked_sizes(connection, half)
    connection.close()


@pytest.mark.parametrize("blob_bytes", [10, 90, 700, 2_000, 5_000, 20_000])
def test_the_chosen_page_size_is_close_to_the_best(blob_bytes: int, tmp_path: Path) -> None:
    def real_cost(page_size: int) -> int:
        path = tmp_path / f"{page_size}.sqlite"
        connection = sqlite3.connect(path)
        connection.execute(f"PRAGMA page_size = {page_size}")
        connection.execute("CREATE TABLE posting (a, b, c BLOB, PRIMARY KEY (a, b)) WITHOUT ROWID")
        connection.executemany(
            "INSERT INTO posting VALUES (?, ?, ?)", [(n // 4, n % 4, b) for n, b in enumerate(blobs)]
        )
        connection.commit()
        connection.execute("VACUUM")
        connection.close()
        return path.stat().st_size - page_size

    blobs = [bytes(blob_bytes + n % 50) for n in range(400)]
    costs = {size: real_cost(size) for size in (4096, 8192, 16384, 32768, 65536)}
    assert costs[fitting_page_size([len(blob) for blob in blobs])] <= 1.2 * min(costs.values())
