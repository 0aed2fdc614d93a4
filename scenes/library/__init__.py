"""Make procedural scenes and scene sets by name."""
