"""Imported by the command before NumPy, which reads the number of its threads once: see dreamer_spec/threads.py."""

from dreamer_spec.threads import limit_numpy

limit_numpy()
