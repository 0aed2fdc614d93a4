"""Measure what a renderer adds to RGB-D simulation, one step at a time."""
