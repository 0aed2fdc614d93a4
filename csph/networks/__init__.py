"""Depth networks, the model that joins code, back-projection and network, its configuration and its posterior."""
