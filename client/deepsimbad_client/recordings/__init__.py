"""Recordings as they lie on disk: frames in travel order with what is known of where each was taken."""
