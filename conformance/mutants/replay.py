"""Mistakes in spec/11-replay.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="workers_share_a_stream",
        explanation="the records of all workers form one stream, so that sequences jump between environments",
        provenance="plausible; NM512/dreamerv3-torch mixed up environments until commit 43e1b2a",
        violates=("REP-1",),
        fix="Keep a stream for each worker.",
        edits={
            "replay.Replay": {"record = self._checked_record(step)": "record, worker = self._checked_record(step), 0"}
        },
    ),
    Mutant(
        name="capacity_counts_records",
        explanation="the capacity counts time steps in place of start positions",
        provenance="plausible: the paper gives no unit (D-80)",
        violates=("REP-4",),
        fix="Count start positions.",
        edits={
            "replay.Replay": {
                "if len(self._items) < self.capacity:": "if len(self._items) < max(1, self.capacity - self.length):"
            }
        },
    ),
    Mutant(
        name="records_are_views",
        explanation="the buffer keeps the arrays that it was given, so that whoever writes into them changes the past",
        provenance="NM512/dreamerv3-torch, from commit 03d91cb to 78e8670, wrote into stored episodes",
        violates=("REP-6",),
        fix="Copy what is stored.",
        edits={
            "replay.Replay": {
                "np.array(value, self._dtypes[key]) for key": "np.asarray(value, self._dtypes[key]) for key"
            }
        },
    ),
    Mutant(
        name="no_online_queue",
        explanation="new sequences wait for their chance like all others",
        provenance="r2dreamer, NM512/dreamerv3-torch and sheeprl have no queue (D-131)",
        violates=("REP-8",),
        fix="Fill a batch from the queue of new sequences first.",
        edits={"replay.Replay": {"(online and self._pop_queue()) or self._draw(u)": "self._draw(u)"}},
    ),
    Mutant(
        name="queue_starts_with_the_first_record",
        explanation="the queue takes the sequences that start at 0, 65, 130 in place of 1, 66, 131",
        provenance="plausible (D-82)",
        violates=("REP-7",),
        fix="Queue the item that record n makes where n is a multiple of T + 1.",
        edits={"replay.Replay": {"position % (self.length + 1) == 0": "position % (self.length + 1) == self.length"}},
    ),
    Mutant(
        name="queue_of_overlapping_sequences",
        explanation="every new sequence is queued, so that each time step is trained on many times",
        provenance="plausible",
        violates=("REP-7",),
        fix="Queue sequences that do not overlap.",
        edits={"replay.Replay": {"if position % (self.length + 1) == 0:": "if True:"}},
    ),
    Mutant(
        name="newest_of_the_queue_first",
        explanation="the queue serves the newest sequence first",
        provenance="plausible",
        violates=("REP-8",),
        fix="First in, first out.",
        edits={"replay.Replay": {"self._queue.popleft()": "self._queue.pop()"}},
    ),
    Mutant(
        name="oldest_of_the_queue_is_dropped",
        explanation="a sequence of the queue that is the oldest of all is taken for evicted",
        provenance="plausible: > in place of >=",
        violates=("REP-9",),
        fix="Drop an entry only if its item is gone.",
        edits={"replay.Replay": {"start >= self._streams[number].first": "start > self._streams[number].first"}},
    ),
    Mutant(
        name="evaluation_empties_the_queue",
        explanation="draws that are not for training take sequences from the queue",
        provenance="plausible",
        violates=("REP-10",),
        fix="Leave the queue alone where online is false.",
        edits={"replay.Replay": {"(online and self._pop_queue())": "self._pop_queue()"}},
    ),
    Mutant(
        name="items_counted_from_the_ring",
        explanation="items are drawn by their place in memory in place of their age",
        provenance="plausible; the same distribution, but not the same item for the same number",
        violates=("REP-12",),
        fix="Count from the oldest item.",
        edits={
            "replay.Replay": {
                "self._items[(self._oldest + min(int(u * n), n - 1)) % n]": "self._items[min(int(u * n), n - 1)]"
            }
        },
    ),
    Mutant(
        name="latents_of_the_first_trained_step",
        explanation="a batch starts from the latents of its first trained step in place of the context step before",
        provenance="plausible",
        violates=("REP-14",),
        fix="Give the latents of position 0, the context.",
        edits={"replay.Replay": {"contexts = [row[:1] for row in rows]": "contexts = [row[1:2] for row in rows]"}},
    ),
    Mutant(
        name="actions_of_the_same_step",
        explanation="prev_action is the action that was taken at the observation of the same step",
        provenance=(
            "DI-engine; NM512/dreamerv3-torch stores the other convention, and mixing the two is off by one (D-91)"
        ),
        violates=("REP-15", "CON-12"),
        fix="Give step t the action of record t - 1.",
        edits={
            "replay.Replay": {
                (
                    'self._gather([row[:-1] for row in rows], "action")'
                ): 'self._gather([row[1:] for row in rows], "action")'
            }
        },
    ),
    Mutant(
        name="first_previous_action_is_lost",
        explanation="the first trained step has no previous action",
        provenance="danijar/dreamerv3 had a wrong one until commit 29eb964 (D-86)",
        violates=("REP-15",),
        fix="Give the first trained step the action of the context step.",
        edits={
            "replay.Replay": {
                "trained = [row[1:] for row in rows]": (
                    'trained = [row[1:] for row in rows]\n        batch["prev_action"][:, 0] = 0'
                )
            }
        },
    ),
    Mutant(
        name="abandoned_episodes_do_not_end",
        explanation="a step before the start of an episode is not marked as the last one",
        provenance="plausible",
        violates=("REP-16",),
        fix="is_last is the stored flag or the is_first of the next step.",
        edits={"replay.Replay": {'batch["is_last"][:, :-1] |= batch["is_first"][:, 1:]\n': "\n"}},
    ),
    Mutant(
        name="sequence_start_is_an_episode_start",
        explanation="the first step of every sequence is marked as the start of an episode",
        provenance="2023 edition, NM512/dreamerv3-torch and sheeprl (D-85)",
        violates=("REP-17",),
        fix="Give the stored flag.",
        edits={
            "replay.Replay": {
                "        return batch\n": '        batch["is_first"][:, 0] = True\n        return batch\n'
            }
        },
    ),
    Mutant(
        name="latents_written_one_step_early",
        explanation="fresh latents are stored one step before the one that they belong to",
        provenance="plausible",
        violates=("REP-20",),
        fix="Write to positions 1 to T: the context keeps its latents.",
        edits={"replay.Replay": {"stream.records.get(start + 1 + t)": "stream.records.get(start + t)"}},
    ),
    Mutant(
        name="latents_never_refreshed",
        explanation="the stored latents stay those of the time of collection",
        provenance="plausible: an older design",
        violates=("REP-20",),
        fix="Write the latents of each train step back.",
        edits={"replay.Replay": {"if record is not None:": "if record is None and False:"}},
    ),
    Mutant(
        name="stream_numbers_used_again",
        explanation="after loading, new streams get numbers that old ones have",
        provenance="plausible; danijar/dreamerv3 once loaded its replay twice (issue 103)",
        violates=("REP-25",),
        fix="Go on counting from the saved number.",
        edits={"replay.Replay": {'int(state["next_stream"])': 'len(state["streams"])'}},
    ),
)
