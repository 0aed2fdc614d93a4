"""Model a multi-zone sensor and calibrate it from captures."""
