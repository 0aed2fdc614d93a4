"""Depth networks, the model that joins code, back-projection and network, and its posterior."""
