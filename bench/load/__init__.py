"""Robots that drive for an hour while their domain is remapped and rolled back: errors, latency, leaks."""
