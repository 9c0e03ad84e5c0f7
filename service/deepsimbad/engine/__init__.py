"""What serves a query: core, store and evaluators composed."""
