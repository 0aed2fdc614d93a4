"""What `--dry-run` says of long commands: plan, memory and an estimate of work with its basis. Nothing is written."""
