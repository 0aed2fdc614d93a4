"""Measure seconds against error of the renderer beside its peers."""
