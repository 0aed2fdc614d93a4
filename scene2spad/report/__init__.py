"""Write one self-contained HTML page of all results in a folder."""
