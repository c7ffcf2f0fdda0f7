"""The commands beside training: `train NAME ...` calls `main(arguments)` of the module of that name."""

COMMANDS: dict[str, str] = {}  # name -> what it does, for --help
