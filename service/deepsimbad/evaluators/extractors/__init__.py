"""Extractors: images -> encodings of unit length; one file each, made by name in `evaluators.registry`."""
