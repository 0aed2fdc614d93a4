"""Transient -> expected counts -> detections -> Histogram, and the classical depth estimators."""
