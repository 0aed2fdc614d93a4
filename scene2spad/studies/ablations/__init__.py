"""Compare designs of coding tensors (supplement S.3)."""
