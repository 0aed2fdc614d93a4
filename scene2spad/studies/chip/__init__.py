"""Run trained codes on emulated cores, and decode depth by their networks."""
