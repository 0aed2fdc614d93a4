"""Indices of refraction of media and metals by name: of media at 589 nm, of metals at 650 nm, whatever the laser's
wavelength."""

# Refractive indices at the sodium line, the names that the file format knows and that exported scenes use.
INDICES = {
    "vacuum": 1.0,
    "air": 1.000277,
    "water": 1.3330,
    "polypropylene": 1.49,
    "bk7": 1.5046,
    "diamond": 2.419,
}

# n and k at 650 nm, interpolated linearly in the tables of: Johnson and Christy, Phys. Rev. B 6, 4370 (1972) for gold,
# silver and copper; Johnson and Christy, Phys. Rev. B 9, 5056 (1974) for chromium; Rakic, Appl. Opt. 34, 4755 (1995)
# for aluminium. "none" is the format's name of a perfect mirror.
CONDUCTORS = {
    "none": (0.0, 1.0),
    "Au": (0.156, 3.602),
    "Ag": (0.052, 4.409),
    "Cu": (0.238, 3.626),
    "Cr": (3.107, 3.331),
    "Al": (1.558, 7.712),
}
