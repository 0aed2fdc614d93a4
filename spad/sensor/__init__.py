"""Describe the camera: bins, pulse, presets, sensor files, photon budget."""
