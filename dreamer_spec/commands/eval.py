"""`train eval CHECKPOINT`: plays episodes with the agent of a checkpoint, on either backend."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dreamer_spec import arguments as keywords
from dreamer_spec.cli import Formatter, Parser
from dreamer_spec.disk.files import replacing, require_place
from dreamer_spec.errors import writing
from dreamer_spec.option_table import EVAL_OPTIONS
from dreamer_spec.training.separate_evaluation import evaluate_checkpoint
from dreamer_spec.words import counted

DESCRIPTION = """Play episodes with the agent of a checkpoint. It samples its actions, as in training, unless --mode is
given.

  train eval runs/CartPole-v1-jax-seed0
  train eval runs/CartPole-v1-jax-seed0/checkpoints/000000020000 --episodes 100 --backend torch --json returns.json"""


def main(arguments: Sequence[str]) -> int:
    """Runs the command. Returns the exit code.

    Raises:
      UserError: a wrong option, a checkpoint that cannot be read, an environment that does not fit it, a file that
        cannot be written.
    """
    values = _parse(arguments)
    file: Path | None = values.pop("json")
    if file:
        with writing(file):
            require_place(file)
    found = evaluate_checkpoint(values.pop("checkpoint"), **values)
    where = f"{found.backend} on {found.device}{', by the mode' if found.mode else ''}"
    played = counted(len(found.returns), "episode")
    print(f"{found.checkpoint}: {found.task}, step {found.step:,}; {played} with {where}, seed {found.seed}")
    print(found)
    if file:
        with writing(file), replacing(file) as opened:
            opened.write((json.dumps(found.to_json(), indent=2) + "\n").encode())
    return 0


def _parse(arguments: Sequence[str]) -> dict[str, Any]:
    """What was given, `json` and `checkpoint` in any case."""
    parser = Parser(prog="train eval", description=DESCRIPTION, formatter_class=Formatter, allow_abbrev=False)
    parser.add_argument(
        "checkpoint",
        type=Path,
        help="a log directory (its newest checkpoint), or one of the folders in its checkpoints/",
    )
    for option in EVAL_OPTIONS:
        parser.add_argument(option.flag, **option.settings)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the summary and every return and length")
    values = vars(parser.parse_args(arguments))
    values["env_arg"] = keywords.join(values["env_arg"] or [])
    return {name: value for name, value in values.items() if value is not None or name == "json"}
