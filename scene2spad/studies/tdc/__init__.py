"""Depth from codes and histograms behind a real time-to-digital converter."""
