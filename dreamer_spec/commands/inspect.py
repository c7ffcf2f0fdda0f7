"""`train inspect PATH`: what was not finite in a train step, where it began, and what usually causes it. Or what a
checkpoint holds."""

import argparse
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from dreamer_spec.backend import Arrays, learner_class
from dreamer_spec.cli import Parser
from dreamer_spec.disk.checkpoint import Checkpoint, candidates, open_checkpoint
from dreamer_spec.disk.incidents import Incident, Tally, load_incident, newest_incident, nonfinite, offending, tally
from dreamer_spec.errors import UserError
from spec import Spaces, hyperparameters, load_config, parameter_table

DESCRIPTION = """Show what a train step met whose loss or gradient was not finite, or what a checkpoint holds.

  train inspect LOGDIR                            the last incident of a run, or its newest checkpoint if it has none
  train inspect LOGDIR/nonfinite/000000000123     one incident, by its train step
  train inspect LOGDIR/checkpoints/000000004000   the tensors of a checkpoint"""

ROWS = 12  # of a table of tensors that are not finite
LARGEST = 5  # parameters with the largest numbers
HUGE_INPUT = math.exp(20)  # the outermost bin: no head can predict more
HUGE_PARAMETER = 1e3  # inputs are normalized and kernels start below 1


def main(arguments: Sequence[str]) -> int:
    """Runs the command. Returns 0, or 1 if `--rerun` was asked for and gave something else.

    Raises:
      UserError: nothing of that kind is there, it is damaged, or the backend does not run.
    """
    options = _parser().parse_args(arguments)
    console = Console(highlight=False, markup=False)
    path = options.path
    if path.parent.name == "checkpoints" or (path / "loop.safetensors").exists():
        if options.rerun:
            raise UserError(f"{path} is a checkpoint; --rerun needs an incident, which has a batch")
        _show_checkpoint(console, open_checkpoint(path))
        return 0
    if not options.rerun and newest_incident(path) is None and candidates(path):
        console.print(
            f"{path}: no train step has met a number that is not finite. The newest checkpoint:", soft_wrap=True
        )
        _show_checkpoint(console, open_checkpoint(path))
        return 0
    incident = load_incident(_find_incident(path))
    _show_incident(console, incident)
    if not options.rerun:
        return 0
    same, words = rerun(incident, options.device)
    console.print(f"\nRerun on {words}")
    return 0 if same else 1


def _parser() -> argparse.ArgumentParser:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = Parser(prog="train inspect", description=DESCRIPTION, formatter_class=formatter, allow_abbrev=False)
    parser.add_argument("path", type=Path, metavar="PATH", help="a log directory, an incident or a checkpoint")
    parser.add_argument(
        "--rerun", action="store_true", help="compute the gradients again and see whether the same ones are not finite"
    )
    parser.add_argument(
        "--device", metavar="NAME", help="of --rerun: cpu, gpu, cuda:1, ... (default: the backend's choice)"
    )
    return parser


def _find_incident(path: Path) -> Path:
    if not path.is_dir():
        raise UserError(
            f"there is no folder {path}; expected a log directory, LOGDIR/nonfinite/NUMBER or LOGDIR/checkpoints/NUMBER"
        )
    if path.parent.name == "nonfinite" or (path / "incident.json").exists():
        return path
    found = newest_incident(path)
    if found is None:
        raise UserError(
            f"{path} holds no incident: no train step has stopped this run. For a checkpoint give its own folder"
        )
    return found


# An incident


def _show_incident(console: Console, incident: Incident) -> None:
    info, (began, cause) = incident.info, diagnose(incident)
    versions = ", ".join(f"{name} {version}" for name, version in info["versions"].items())
    console.print(f"{incident.path}", soft_wrap=True)
    task = info["identity"].get("task", "unknown task")
    console.print(
        f"{task}, train step {info['train_step']} (step {info['step']}), {info['backend']} on "
        f"{info['device']}; {versions}"
    )
    console.print(f"\nIt began in {began}")
    console.print(
        f"Metrics not finite: {_listed(f'{name} {value}' for name, value in nonfinite(incident.metrics).items())}"
    )
    gradients = [one.name for one in incident.tallies if one.kind == "gradient"]
    if gradients:
        console.print(f"Gradients not finite: {_by_network(gradients, incident.state)}")
    console.print(f"\nUsual cause: {cause}")
    _show_tallies(console, incident.tallies)
    _show_ranges(console, "Batch", incident.batch)
    _show_largest(console, incident.state)


def diagnose(incident: Incident) -> tuple[str, str]:
    """Where it began and what usually causes that: the first that is not finite of batch, state, losses and
    gradients."""
    by_kind: dict[str, list[Tally]] = {
        kind: [one for one in incident.tallies if one.kind == kind] for kind in ("batch", "state", "gradient")
    }
    if by_kind["batch"]:
        places = [f"{one.name}{_first_place(incident.batch.get(one.name))}" for one in by_kind["batch"]]
        return f"the batch: {_listed(places)}", (
            "what environments return is checked, and latents that are not finite are not "
            "written back, so it was spoiled on its way: "
            "code of your own between environment and buffer, or a fault of memory or disk"
        )
    if by_kind["state"]:
        return f"the training state: {_listed(one.name for one in by_kind['state'])}", (
            "no train step leaves such a state behind, so it was loaded: go back to an older checkpoint"
        )
    losses = [name for name in nonfinite(incident.metrics) if name.startswith("loss/") and name != "loss/total"]
    if not losses and not by_kind["gradient"] and not nonfinite(incident.repeated):
        return "nothing that could be repeated: the same step gave finite numbers", (
            "kernels that are not deterministic, at the edge of what their numbers can hold, or a fault of the machine"
        )
    if losses:
        return f"the losses, from a finite batch and finite parameters: {_listed(losses)}", _overflow(incident)
    if by_kind["gradient"]:
        return "the gradients, on the way back from finite losses", _overflow(incident)
    return "sums: the total loss or the norm of finite gradients is larger than any float", _overflow(incident)


def _overflow(incident: Incident) -> str:
    """What may have made finite numbers overflow."""
    inputs = {name: tally("batch", name, array).largest or 0.0 for name, array in incident.batch.items()}
    key = max(inputs, key=lambda name: inputs[name], default="")
    if key and inputs[key] > HUGE_INPUT:
        return f"{key} reaches {inputs[key]:.3g}, and products of such numbers overflow: scale it in the environment"
    name, largest = max(_parameters(incident.state), key=lambda entry: entry[1], default=("", 0.0))
    if largest > HUGE_PARAMETER:
        return (
            f"parameters have grown, {name} to {largest:.3g}: train from an older "
            f"checkpoint with a smaller --learning-rate"
        )
    dtype = incident.info["identity"].get("compute_dtype")
    if dtype == "bfloat16":
        return "rounding in bfloat16: try --compute-dtype float32, or a smaller --learning-rate"
    return "a step that was too long: try a smaller --learning-rate, or --nonfinite skip if it happens rarely"


def _first_place(array: np.ndarray | None) -> str:
    """The index of the first number that is not finite, as [0, 3]."""
    places = np.argwhere(~np.isfinite(array)) if array is not None else np.empty(0)
    return str(places[0].tolist()) if len(places) else ""


def _by_network(names: Iterable[str], state: Arrays) -> str:
    """encoder 2 of 5, rssm 14 of 14"""
    broken = Counter(name.split("/")[0] for name in names)
    total = Counter(name.split("/")[1] for name in state if name.startswith("params/"))
    return ", ".join(f"{network} {count} of {total[network]}" for network, count in broken.items())


def rerun(incident: Incident, device: str | None) -> tuple[bool, str]:
    """Whether the gradients of the step, computed again, are not finite under the same names; and the same in words.

    Raises:
      UserError: the files do not fit each other, or the backend does not run.
    """
    info = incident.info
    try:
        if info["backend"] not in ("jax", "torch"):  # A file does not choose which module is imported.
            raise ValueError(f"unknown backend {info['backend']!r:.80}")
        spaces = Spaces.from_json(info["spaces"])
        config = load_config("paper", "tiny", **{name: info["identity"][name] for name in hyperparameters()})
        expected = {f"params/{name}": entry.shape for name, entry in parameter_table(config, spaces).items()}
        present = {name: array.shape for name, array in incident.state.items() if name.startswith("params/")}
        if present != expected:  # Before any memory is taken for them.
            raise ValueError("the parameters are not those of the configuration")
        learner = learner_class(info["backend"])(spaces, config, seed=0, device=device)
        learner.load_state_dict(incident.state)
        metrics, gradients = learner.gradients(incident.batch, info["seed"])
    except ModuleNotFoundError as error:
        raise UserError(
            f"the backend {info['backend']} needs the package {error.name}: pip install "
            f"'dreamer-spec[{info['backend']}]'"
        ) from error
    except (ValueError, KeyError) as error:
        raise UserError(f"the incident {incident.path} cannot be repeated: {error}") from error
    before = {*nonfinite(incident.repeated), *(one.name for one in incident.tallies if one.kind == "gradient")}
    now = {*nonfinite(metrics), *(one.name for one in offending("gradient", gradients))}
    if now == before:
        return True, f"{learner.device}: the same {len(now)} metrics and gradients are not finite"
    words = (
        f"Only before: {_listed(sorted(before - now)) or 'none'}; only now: {_listed(sorted(now - before)) or 'none'}"
    )
    return False, f"{learner.device}: other metrics and gradients are not finite. {words}"


# A checkpoint


def _show_checkpoint(console: Console, checkpoint: Checkpoint) -> None:
    state, counters = checkpoint.learner, checkpoint.info.get("counters")
    console.print(f"{checkpoint.path}", soft_wrap=True)
    if isinstance(counters, dict):
        console.print(_listed((f"{name.replace('_', ' ')} {value}" for name, value in counters.items()), 10))
    broken = offending("state", state)
    console.print(f"\n{len(broken)} of {len(state)} tensors hold numbers that are not finite")
    _show_tallies(console, broken)
    groups: dict[str, list[np.ndarray]] = {}
    for name, array in state.items():
        groups.setdefault(_group(name), []).append(array.ravel())
    _show_ranges(console, "Training state", {name: np.concatenate(arrays) for name, arrays in groups.items()})
    _show_largest(console, state)


def _group(name: str) -> str:
    """params/rssm/gru/kernel -> params/rssm, optimizer/momentum/... -> optimizer/momentum, slow_critic/... ->
    slow_critic."""
    return "slow_critic" if name.startswith("slow_critic/") else "/".join(name.split("/")[:2])


# Tables


def _show_tallies(console: Console, tallies: Sequence[Tally]) -> None:
    if not tallies:
        return
    table = _table("", "tensor", "not finite", "of", "largest finite")
    for one in tallies[:ROWS]:
        counts = {"NaN": one.nan, "inf": one.inf, "-inf": one.negative_inf}
        words = ", ".join(f"{count:,} {word}" for word, count in counts.items() if count)
        table.add_row(
            one.kind, one.name, words, f"{one.elements:,}", "" if one.largest is None else _number(one.largest)
        )
    console.print("\nNot finite", style="bold")
    console.print(table)
    if len(tallies) > ROWS:
        console.print(f" and {len(tallies) - ROWS} more")


def _show_ranges(console: Console, title: str, arrays: Arrays) -> None:
    table = _table("", "shape", "min", "max", "RMS", "not finite")
    for name, array in arrays.items():
        finite = array[np.isfinite(array)]
        numbers = (finite.min(), finite.max(), _rms(finite)) if finite.size else ()
        share = 1 - finite.size / array.size if array.size else 0.0
        cells = [_number(float(number)) for number in numbers] or [""] * 3
        table.add_row(name, " × ".join(f"{side:,}" for side in array.shape), *cells, f"{share:.2%}" if share else "0")
    console.print(f"\n{title}", style="bold")
    console.print(table)


def _show_largest(console: Console, state: Arrays) -> None:
    table = _table("", "largest", "RMS")
    for name, largest in sorted(_parameters(state), key=lambda entry: -entry[1])[:LARGEST]:
        array = state[f"params/{name}"]
        table.add_row(name, _number(largest), _number(_rms(array[np.isfinite(array)])))
    console.print("\nParameters with the largest numbers", style="bold")
    console.print(table)


def _parameters(state: Arrays) -> list[tuple[str, float]]:
    """Name and largest absolute finite number of every parameter that has one."""
    names = [name for name in state if name.startswith("params/")]
    largest = ((name.removeprefix("params/"), tally("state", name, state[name]).largest) for name in names)
    return [(name, number) for name, number in largest if number is not None]


def _rms(array: np.ndarray) -> float:
    return math.sqrt(np.mean(np.square(array, dtype=np.float64)))


def _table(*columns: str) -> Table:
    """Names are to the left, numbers to the right."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False)
    for column in columns:
        table.add_column(column, justify="left" if column in ("", "tensor") else "right", overflow="fold")
    return table


def _number(value: float) -> str:
    return f"{value:.4g}"


def _listed(words: Iterable[str], most: int = 6) -> str:
    """a, b, c and 2 more"""
    all_words = list(words)
    rest = len(all_words) - most
    return ", ".join(all_words[:most]) + (f" and {rest} more" if rest > 0 else "")
