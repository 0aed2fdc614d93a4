"""Commands from a scene to depth: what is there, render, sense, estimate; and the sensor's calibration."""
