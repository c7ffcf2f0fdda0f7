"""The commands of `conformance`.

A module has a docstring, whose first line is its help, `add_arguments(parser)` and `main(console, options) -> exit
code`.
"""

COMMANDS = ("check", "coverage", "docs", "lockstep", "mutants", "new_adapter", "report", "vectors")
