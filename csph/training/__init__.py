"""Train depth networks: patches sensed on the fly, loss, schedule, resume."""
