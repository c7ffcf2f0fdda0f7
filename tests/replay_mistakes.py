"""Mistakes that one can make in the buffer, planted one at a time."""

import __future__

import dataclasses
import inspect
import textwrap
from typing import Any

import pytest

from dreamer_spec.replay import batches, buffer, contents, items, journal, recovery, saves, storage


@dataclasses.dataclass(frozen=True)
class Mistake:
    """`wrong` instead of `right` in a function `name` of an owner (a module or a class)."""

    explanation: str
    owner: Any
    name: str
    right: str
    wrong: str

    def plant(self, monkeypatch: pytest.MonkeyPatch) -> None:
        function = inspect.getattr_static(self.owner, self.name)
        source = textwrap.dedent(inspect.getsource(function))
        assert source.count(self.right) >= 1, f"{self.name} has no {self.right!r} any more"
        namespace: dict[str, Any] = {}
        code = compile(source.replace(self.right, self.wrong), self.name, "exec", __future__.annotations.compiler_flag)
        exec(code, function.__globals__, namespace)
        monkeypatch.setattr(self.owner, self.name, namespace[self.name])


Storage, Items, Epochs = storage.Storage, items.Items, saves.Epochs
Contents, Replay = contents.Contents, buffer.Replay

MISTAKES = [
    # The chapter.
    Mistake(
        "the queue takes the sequences 0, L, 2L",
        Contents,
        "append",
        "position % (self.length + 1) == 0",
        "(position + 1) % (self.length + 1) == 0",
    ),
    Mistake("item 0 is the newest", Items, "draw", "int(u * self._count)", "self._count - 1 - int(u * self._count)"),
    Mistake(
        "one item too many is kept",
        Contents,
        "append",
        "len(self.items) == self.capacity",
        "len(self.items) > self.capacity",
    ),
    Mistake("evicted records take a write-back", Replay, "write_back", "max(start + 1, stream.first)", "start + 1"),
    Mistake("the context is overwritten too", Replay, "write_back", "start + 1", "start"),
    Mistake("evicted entries of the queue are served", Items, "pop_oldest", "self.queue.popleft()", "pass"),
    Mistake("the previous action is the action", batches, "_unpack", "records[key][:, :-1]", "records[key][:, 1:]"),
    Mistake(
        "an abandoned episode goes on", batches, "_unpack", '|= batch["is_first"][:, 1:]', '|= batch["is_last"][:, 1:]'
    ),
    Mistake(
        "a row after a chunk's end comes one too early", buffer, "gather", "span.done - 1 + context :", "span.done :"
    ),
    Mistake(
        "the second chunk is read from the first one's row",
        Storage,
        "spans",
        "index, row = divmod(position, self.records)",
        "index, row = position // self.records, start % self.records",
    ),
    Mistake("the ring forgets its turn", Items, "codes", "self._ring[: max(0, end - self.capacity)]", "self._ring[:0]"),
    Mistake(
        "the row in the block is that in the chunk",
        Storage,
        "replace_latents",
        "span.stage.sections[-1][span.stage_row : span.stage_row",
        "span.stage.sections[-1][span.chunk_row : span.chunk_row",
    ),
    # Saving and coming back.
    Mistake("nothing is written to the journal", Storage, "_remember", "self.epochs.journal.append", "len"),
    Mistake(
        "staged latents are not written to the journal",
        Storage,
        "_remember",
        "if len(fresh) and",
        "if span.stage is None and len(fresh) and",
    ),
    Mistake("the journal is written after the deed", Storage, "replace_latents", "self._remember(span)", "pass"),
    Mistake(
        "undone from the oldest journal on",
        recovery,
        "_undo",
        "reversed([number for number in journal_epochs(directory) if number >= epoch])",
        "[number for number in journal_epochs(directory) if number >= epoch]",
    ),
    Mistake(
        "only the last epoch is undone",
        recovery,
        "_undo",
        "number >= epoch",
        "number == max(journal_epochs(directory))",
    ),
    Mistake(
        "what was touched stays touched",
        recovery,
        "save",
        "chunk.saved, chunk.touched = chunk.count, None",
        "chunk.saved = chunk.count",
    ),
    Mistake(
        "what is saved is not remembered",
        recovery,
        "save",
        "chunk.saved, chunk.touched = chunk.count, None",
        "chunk.touched = None",
    ),
    Mistake("the newest records are not written", recovery, "save", "storage.write_stage(stream)", "pass"),
    Mistake("checksums of latents grow old", recovery, "save", "storage.sum_latents(chunk)", "pass"),
    Mistake("chunks go though a save needs them", Epochs, "retire", "return not needed", "return True"),
    Mistake(
        "journals go though a save needs them",
        Epochs,
        "keep",
        "epoch < min(self.kept, default=self.epoch) and epoch != self.epoch",
        "epoch != self.epoch",
    ),
    Mistake("the journal is emptied before later ones are gone", Epochs, "resume", "later > epoch", "False"),
    Mistake(
        "a later save survives the restore", recovery, "restore", "saved_path(replay.directory, epoch).unlink()", "pass"
    ),
    Mistake("the queue does not come back", recovery, "_rebuild", "replay.items.queue.extend(", "list("),
    Mistake("the unfinished block is not loaded", recovery, "_held", "storage.read_stage(stream)", "pass"),
    Mistake(
        "numbers of streams are used again", recovery, "restore", 'replay.next_stream = facts["next_stream"]', "pass"
    ),
    Mistake(
        "streams go on after a restart",
        Replay,
        "load_state_dict",
        "self.clear()",
        "current = dict(self.current); self.clear(); self.current = current",
    ),
    Mistake(
        "an entry of the journal is torn",
        journal.Journal,
        "append",
        "write_all(self._fd, data, self._size + len(header))",
        "pass",
    ),
]
