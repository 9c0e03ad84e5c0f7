"""The contest for the embedded extractor: `python -m bench.extractors` measures every candidate.

A candidate is a function of the landmark traverse's images that gives an extractor; only those that must be fitted
look at the images. The winner lives in the service, the others here, one file each.
"""
