"""Turn a transient's flux into detections: laws, draws, training patches."""
