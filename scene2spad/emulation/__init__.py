"""Run recorded photons through emulated cores, and take depth from what they put out."""
