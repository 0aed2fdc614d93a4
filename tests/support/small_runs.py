"""Options of the quickest training."""

QUICK = ["--preset", "smoke", "--threads", "1"]
