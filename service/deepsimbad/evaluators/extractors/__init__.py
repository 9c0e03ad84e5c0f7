"""Embedded extractors: image -> unit-length encoding, with no download and no training; one file each."""
