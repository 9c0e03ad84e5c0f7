"""Migrations of one traverse file."""
