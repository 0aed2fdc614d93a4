"""Move test scenes away from the depths of the training set (supplement S.1)."""
