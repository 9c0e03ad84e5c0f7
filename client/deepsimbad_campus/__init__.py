"""A small rendered campus: several drives along one seeded route, written in NCLT's layout.

It stands in for the real recordings, which are 100 GB each, wherever a first run or a test needs images of the same
places in different seasons. Needs the `replay` extra.
"""
