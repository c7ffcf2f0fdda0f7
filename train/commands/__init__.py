"""The commands beside training: `train NAME ...` calls `main(arguments)` of the module of that name."""

COMMANDS: dict[str, str] = {  # name -> what it does, for --help
    "inspect": "what a train step met whose loss or gradient was not finite; what a checkpoint holds",
}
