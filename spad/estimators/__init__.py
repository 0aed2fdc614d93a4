"""Estimate depth from counts without a network."""
