"""Imported by worker processes before NumPy: an environment gets one thread, the cores are for the learner and for
other environments. And before our other packages: somebody's module of the same name must not be taken for one."""

import os
import sys

for _name in (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
):
    os.environ[_name] = "1"

# The server that workers are forks of is started by `python -c`, which looks where it is started first, as the command
# itself does not. What a worker imports later it looks for where its trainer does.
_home = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if sys.path[:1] == [""] and not os.path.samefile(os.curdir, _home):
    del sys.path[0]
