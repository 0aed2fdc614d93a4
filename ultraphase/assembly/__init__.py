"""Assemble, encode, list and translate programs of the core."""
