"""Regenerate the experiments of the paper's supplement from geometry, one module or folder a study."""
