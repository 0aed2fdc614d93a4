"""Hold what an exposure leaves: counts, timestamps, and the metadata beside them."""
