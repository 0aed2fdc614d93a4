"""Integrate direct light: footprints of rays, cells of pixels, edges between cells."""
