"""Estimate indirect light: camera paths, reuse between pixels, light vertices, light tracing, path-space filter."""
