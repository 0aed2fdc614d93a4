"""Make the things that procedural scenes are furnished with."""
