"""Coding tensors: temporal codes, designs, encoding and correlation decoding, 8-bit codes."""
