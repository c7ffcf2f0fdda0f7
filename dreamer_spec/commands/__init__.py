"""The commands beside training: `train NAME ...` calls `main(arguments)` of the module of that name."""

COMMANDS: dict[str, str] = {  # name -> what it does, for --help
    "bsuite": "writes runs of BSuite as its package reads them, for the scores of the benchmark",
    "eval": "plays episodes with a checkpoint, on either backend",
    "export": "writes the policy of a checkpoint as a folder that runs with NumPy alone",
    "inspect": "what a train step met whose loss or gradient was not finite; what a checkpoint holds",
    "report": "one HTML page about one run or many",
    "sweep": "trains every combination of tasks, seeds and options, some at once",
    "tasks": "lists the suites of tasks, their protocols, and what must be installed for each",
    "resume": "continues a run with the options that it was started with, but for those given here",
    "score": "final scores of runs by a stated protocol, beside the paper's",
}
