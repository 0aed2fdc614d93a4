"""Estimate depth from counts without a network, and turn recorded times into depth."""
