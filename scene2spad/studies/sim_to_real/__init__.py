"""Predict a real chip's histograms of a plane, say which effect explains what, and find the plane's pose from them."""
