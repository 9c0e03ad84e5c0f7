"""Migrations of one map file."""
