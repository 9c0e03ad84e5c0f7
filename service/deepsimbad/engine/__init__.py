"""Core, store and evaluators composed to serve queries."""
