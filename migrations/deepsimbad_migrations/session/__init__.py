"""Migrations of the file of live sessions."""
