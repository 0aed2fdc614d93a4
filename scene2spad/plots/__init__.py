"""Draw what the chain makes, with units on every axis."""
