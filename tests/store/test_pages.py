import sqlite3
from pathlib import Path

import pytest

from deepsimbad.store.pages import fitting_page_size


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
