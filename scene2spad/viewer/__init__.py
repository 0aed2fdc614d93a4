"""Self-contained HTML pages to look into files: the page loads nothing, and its data travel compressed within it."""
