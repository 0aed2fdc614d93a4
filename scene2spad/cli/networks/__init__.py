"""Commands of trained networks: train, list, evaluate."""
