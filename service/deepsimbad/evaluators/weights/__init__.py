"""Files of weights: which families there are, how each is told from its content and read without running any of it."""
