"""`python -m dreamer_spec` is the command `train`."""

import sys

from dreamer_spec.cli import main

if __name__ == "__main__":
    sys.exit(main())
