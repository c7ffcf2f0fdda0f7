"""Training for real: `train --backend jax|torch --task SUITE:NAME`. The way through: cli.py, options.py, training/.

The rooms by level, the lowest first. A module imports from lower levels and from its own room: never from above, never
from another room of its level, never in a circle. tests/test_repository.py reads this table and checks it.

  errors, words                         what the user can mend, in one line; how counts are said
  system                                the process and its machine: cores, memory, threads, signals
  arguments, backend, options, resize   what a run is, and the interface to what trains
  translation                           an environment's values as arrays, and flat actions as the environment's
  disk                                  what a run leaves: its record, checkpoints, incidents, and reading without trust
  envs, policy, replay                  environments; a trained agent with NumPy alone; the buffer of chapter 11
  monitoring                            what people see of a run: metrics, progress, curve, predictions, films, outcome
  report, training                      the HTML page about runs; a run from its options to its end
  commands                              the names of the commands beside training
  cli                                   the command line
  commands.*, __main__                  what each command does
"""
