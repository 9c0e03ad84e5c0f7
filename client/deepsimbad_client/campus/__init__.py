"""A small rendered campus: several drives along one seeded route, written in NCLT's layout.

Needs the `replay` extra. It stands in for the real recordings, which are 100 GB each, wherever a first run or a test
needs images of the same places in different seasons.
"""

from deepsimbad_client.campus.season import PAPER_DATES
from deepsimbad_client.campus.writer import WrittenDrive, write_campus

__all__ = ["PAPER_DATES", "WrittenDrive", "write_campus"]
