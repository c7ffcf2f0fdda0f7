"""Imported by the command before NumPy, which reads the number of its threads once: see train/threads.py."""

from train.threads import limit_numpy

limit_numpy()
