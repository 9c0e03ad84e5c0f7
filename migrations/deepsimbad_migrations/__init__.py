"""Frozen schema migrations."""
