"""Imported by the command before NumPy, which reads the number of its threads once: see threads.py beside it."""

from dreamer_spec.system.threads import limit_numpy

limit_numpy()
