"""Measurements behind the figures in docs/results; `make bench` runs them all."""
