"""What a run leaves on the disk: its record, checkpoints, incidents, and how files are written and read."""
