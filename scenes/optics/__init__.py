"""Constants and laws of optics: spectra of hot bodies, refractive indices."""
