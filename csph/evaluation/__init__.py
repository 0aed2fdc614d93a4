"""Compare depth methods on the same photons: the 16 levels, figures of merit, memory."""
