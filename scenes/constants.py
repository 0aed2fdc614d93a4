"""Physical constants, and the response at which every stage states its error. One copy each, imported everywhere."""

SPEED_OF_LIGHT_M_PER_S = 299_792_458.0

# The `reference` sensor of the ICCV 2023 evaluation: 1024 bins over 100 ns, Gaussian pulse of sigma 135 ps
# (FWHM 318 ps). `spad` makes its preset of these numbers; `render` judges its error at this response.
REFERENCE_BINS = 1024
REFERENCE_PERIOD_S = 100e-9
REFERENCE_PULSE_SIGMA_S = 135e-12

MAX_PHOTONS = 1e9  # of a photon budget: mean signal, or mean background, of a pixel and exposure

# Of lasers whose wavelength nobody states: where light at this wavelength is needed (sunlight, a photon budget).
DEFAULT_WAVELENGTH_M = 850e-9
