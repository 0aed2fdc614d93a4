"""Measure time, data rate and power of emulated programs (supplement S.2)."""
