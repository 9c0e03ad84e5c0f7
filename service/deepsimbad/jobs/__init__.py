"""Offline stages: plain functions with progress and cancel."""
