"""The calls of the HTTP contract, one noun per file."""
