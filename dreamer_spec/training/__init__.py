"""What runs: a run from its options to its end. The way through: loop.py, setup.py, schedule.py."""
