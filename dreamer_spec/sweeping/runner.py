"""Runs what a plan holds, and remembers what has ended: the same command goes on where it was stopped."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dreamer_spec.disk.files import Unreadable, read_json, replacing
from dreamer_spec.errors import UserError, writing
from dreamer_spec.sweeping.places import INTERRUPTED, Place
from dreamer_spec.sweeping.plan import Item, Plan
from dreamer_spec.system.signals import Signals

WAITING, RUNNING, DONE, FAILED, STOPPED = "waiting", "running", "done", "failed", "stopped"
POLL = 0.5  # seconds


@dataclasses.dataclass
class State:
    """Where an item is. code: its exit code, once it has ended."""

    item: Item
    phase: str = WAITING
    handle: Any = None
    code: int | None = None


class Sweep:
    """The runs of a plan, `jobs` of them at once. What has ended without an error is noted in LOGDIR/sweep.json with
    its command, and is not run again; anything else is given to `train` again, which continues it.

    Raises:
      UserError: the log directory cannot be written.
    """

    def __init__(self, plan: Plan, place: Place) -> None:
        self._plan, self._place = plan, place
        self._path = plan.logdir / "sweep.json"
        with writing(plan.logdir):
            (plan.logdir / "logs").mkdir(parents=True, exist_ok=True)
        self._ended = _read(self._path)
        self.states = [State(item, DONE if self._has_ended(item) else WAITING) for item in plan.items]

    def run(self, signals: Signals, show: Callable[[list[State]], None]) -> int:
        """Until all have ended, or a signal came. Returns the exit code: 0; 130 after a signal; 2 if a run failed, or
        somebody stopped it.

        show: is told of the states, twice a second.

        Raises:
          UserError: the disk refuses a note or a log. The runs under way have ended then, with checkpoints if they
            could.
        """
        try:
            while any(state.phase in (WAITING, RUNNING) for state in self.states):
                if signals.received:
                    return self._stop(show)
                self._start_next()
                show(self.states)
                time.sleep(POLL)
                if self._collect():
                    self._write()
        except UserError:
            with contextlib.suppress(UserError):  # the same disk
                self._stop(show)
            raise
        show(self.states)
        return 2 if any(state.phase in (FAILED, STOPPED) for state in self.states) else 0

    def _start_next(self) -> None:
        running = sum(state.phase == RUNNING for state in self.states)
        for state in [state for state in self.states if state.phase == WAITING][: self._plan.jobs - running]:
            state.handle = self._place.start(state.item.command, log_of(self._plan, state.item))
            state.phase = RUNNING

    def _collect(self) -> bool:
        """Whether a run has ended that is to be noted."""
        noted = False
        for state in self.states:
            if state.phase == RUNNING and (code := self._place.code(state.handle)) is not None:
                state.code, state.phase = code, {0: DONE, INTERRUPTED: STOPPED}.get(code, FAILED)
                if state.phase == DONE:
                    self._ended[state.item.name] = list(state.item.command)
                    noted = True
        return noted

    def _stop(self, show: Callable[[list[State]], None]) -> int:
        for state in self.states:
            if state.phase == RUNNING:
                self._place.end(state.handle)
        noted = False
        while any(state.phase == RUNNING for state in self.states):
            time.sleep(POLL)
            noted |= self._collect()
            show(self.states)
        if noted:
            self._write()
        return INTERRUPTED

    def _has_ended(self, item: Item) -> bool:
        return self._ended.get(item.name) == list(item.command)

    def _write(self) -> None:
        text = json.dumps({"format": 1, "ended": self._ended}, indent=1)
        with writing(self._path), replacing(self._path) as file:
            file.write(text.encode())


def log_of(plan: Plan, item: Item) -> Path:
    """The file with what a run said."""
    return plan.logdir / "logs" / f"{item.name}.log"


def _read(path: Path) -> dict[str, list[str]]:
    try:
        content: Mapping[str, Any] = read_json(path) if path.exists() else {"format": 1, "ended": {}}
        ended = content["ended"]
        if content["format"] != 1 or not all(isinstance(command, list) for command in ended.values()):
            raise ValueError("not what a sweep writes")
        return dict(ended)
    except (Unreadable, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: {error}; it notes which runs have ended. Remove it, and every run is started again, "
            f"which ends at once where nothing is left to do"
        ) from error
