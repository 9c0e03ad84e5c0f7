"""The experience database: Q-values, and the episodes that they are trained by."""
