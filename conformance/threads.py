"""Imported by the command before NumPy: one thread for each library, unless the environment says otherwise.

What is computed is small. Where several libraries have several threads each, on a machine that does other things too,
they spend most of their time waiting for each other.
"""

import os

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
