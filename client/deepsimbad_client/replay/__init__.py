"""Recordings driven against a live service, judged by the truth, told and drawn."""
