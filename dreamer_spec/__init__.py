"""Training for real: `train --backend jax|torch --task SUITE:NAME`. The way through: cli.py, options.py, loop.py."""
