"""How far the runs of a sweep are: a table that is drawn again and again, or a line for every change."""

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from dreamer_spec.monitoring.outcome import read_outcome
from dreamer_spec.sweeping.runner import DONE, FAILED, RUNNING, WAITING, State

TAIL = 2**16  # bytes: at the end of metrics.jsonl the newest step and return stand in these
ROWS = 30  # of the table, the rest is counted


@contextlib.contextmanager
def shown(console: Console) -> Iterator[Callable[[list[State]], None]]:
    """What draws states."""
    if not console.is_terminal:
        told: dict[str, str] = {}

        def tell(states: list[State]) -> None:
            for state in states:
                if state.phase not in (WAITING, told.get(state.item.name)):
                    told[state.item.name] = state.phase
                    console.print(f"{state.item.name}: {_words(state)}", soft_wrap=True)

        yield tell
        return
    with Live(console=console, auto_refresh=False) as live:
        yield lambda states: live.update(table(states), refresh=True)


def table(states: list[State]) -> Table:
    """The runs under way first, then those that wait, then those that ended."""
    order = {RUNNING: 0, FAILED: 1, WAITING: 2}
    counts = {phase: sum(state.phase == phase for state in states) for phase in dict.fromkeys(s.phase for s in states)}
    title = ", ".join(f"{count} {phase}" for phase, count in counts.items())
    view = Table(box=box.SIMPLE, title=f"{len(states)} runs: {title}", title_justify="left")
    view.add_column("run", overflow="fold")
    view.add_column("state")
    for column in ("step", "of", "return"):
        view.add_column(column, justify="right")
    ordered = sorted(states, key=lambda state: order.get(state.phase, 3))
    for state in ordered[:ROWS]:
        step, score = newest(state.item.options.logdir)
        known = "" if score is None else f"{score:.4g}"
        view.add_row(state.item.name, state.phase, f"{step:,}", f"{state.item.options.steps:,}", known)
    if len(ordered) > ROWS:
        view.add_row(f"and {len(ordered) - ROWS} more", "", "", "", "")
    return view


def newest(logdir: Path) -> tuple[int, float | None]:
    """The step of the last line of metrics, and the newest return of an episode."""
    step, score = 0, None
    for line in last_lines(logdir / "metrics.jsonl"):
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            entry = json.loads(line)
            step = max(step, int(entry.get("step", 0)))
            score = entry.get("evaluation/return", entry.get("episode/return", score))
    return step, score


def last_lines(path: Path) -> list[bytes]:
    """Those in the last TAIL bytes, the first of which may be cut; none where there is no file."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL))
        return file.read().split(b"\n")
    return []


def _words(state: State) -> str:
    if state.phase == DONE:
        return f"done, {read_outcome(state.item.options.logdir).score or 'no episode'}"
    return state.phase + (f" with exit code {state.code}" if state.phase == FAILED else "")
