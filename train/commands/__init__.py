"""The commands beside training: `train NAME ...` calls `main(arguments)` of the module of that name."""

# name -> what it does, for --help
COMMANDS: dict[str, str] = {
    "report": "one HTML page about one run or many: train report LOGDIR... [--out FILE]",
}
