"""Offline experiments: the paper's, and ours beside them, over recorded drives."""
