"""Migrations of the catalog: domains, map versions and jobs."""
