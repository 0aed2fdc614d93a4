"""Train depth networks: configuration, patches sensed on the fly, loss, schedule, resume."""
