"""Integrate ambient light: camera paths, light paths from lamps by way of mirrors and glass, bilateral filter."""
