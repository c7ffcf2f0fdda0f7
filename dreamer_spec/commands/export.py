"""`train export CHECKPOINT FOLDER`: the policy of a checkpoint as a folder that runs with NumPy alone, see
docs/policy.md."""

from collections.abc import Sequence
from pathlib import Path

from dreamer_spec.cli import Parser
from dreamer_spec.disk.checkpoint import open_checkpoint
from dreamer_spec.disk.saved_agent import agent_of
from dreamer_spec.policy import save


def main(arguments: Sequence[str]) -> int:
    """Runs the command. Returns the exit code.

    Raises:
      UserError: the checkpoint cannot be read, or the folder exists already or cannot be written.
    """
    parser = Parser(
        prog="train export", description="Write the policy of a checkpoint as a folder that runs with NumPy alone."
    )
    parser.add_argument(
        "checkpoint",
        type=Path,
        help="a log directory (its newest checkpoint), or one of the folders in its checkpoints/",
    )
    parser.add_argument("folder", type=Path, help="the folder to write; it must not exist")
    values = parser.parse_args(arguments)
    checkpoint = open_checkpoint(values.checkpoint)
    saved = agent_of(checkpoint)
    save(values.folder, saved)
    print(f"{values.folder}: the policy of {checkpoint.path} ({saved.info['task']}, step {saved.info['step']:,})")
    return 0
