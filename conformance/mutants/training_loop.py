"""Mistakes in spec/12-training-loop.md."""

from conformance.mutants.catalogue import Mutant

MUTANTS = (
    Mutant(
        name="time_limit_is_terminal",
        explanation="a time limit is recorded as a termination",
        provenance=(
            "navix, sheeprl until issue 252, DI-engine, NaturalDreamer; the Atari "
            "environment of danijar/dreamerv3 (D-96)"
        ),
        violates=("LOOP-10", "CON-11"),
        fix="is_terminal is the environment's `terminated`, without `truncated`.",
        edits={
            "training_loop.step_flags": {
                "bool(terminated or truncated), bool(terminated)": (
                    "bool(terminated or truncated), bool(terminated or truncated)"
                )
            }
        },
    ),
    Mutant(
        name="reset_counts_as_the_end",
        explanation="the observation of an automatic reset carries the end of the episode before",
        provenance="plausible; sheeprl stored is_first wrongly until issue 225",
        violates=("LOOP-7", "LOOP-11"),
        fix="What a reset returns is_first and nothing else.",
        edits={"training_loop.step_flags": {"ended and not reset": "ended", "terminal and not reset": "terminal"}},
    ),
    Mutant(
        name="reset_keeps_the_reward",
        explanation="the first record of an episode holds the last reward of the episode before",
        provenance="plausible: the reward that came with an automatic reset",
        violates=("LOOP-9", "CON-10"),
        fix="Store a reward of 0 where is_first.",
        edits={"training_loop.make_record": {'0.0 if flags["is_first"] else reward': "reward"}},
    ),
    Mutant(
        name="last_action_kept",
        explanation="the last record of an episode holds an action that was never taken",
        provenance="plausible (D-91)",
        violates=("LOOP-9",),
        fix="Store zeros where is_last.",
        edits={"training_loop.make_record": {'np.zeros_like(action) if flags["is_last"] else action': "action"}},
    ),
    Mutant(
        name="clipped_action_stored",
        explanation="the record holds the clipped action in place of the sample",
        provenance="NM512/dreamerv3-torch wrote scaled actions into its episodes until commit 78e8670",
        violates=("LOOP-9", "CON-27"),
        fix="Store the raw sample, and clip what the environment gets.",
        edits={"training_loop.make_record": {"else action, np.float32)": "else np.clip(action, -1, 1), np.float32)"}},
    ),
    Mutant(
        name="environment_gets_unclipped_actions",
        explanation="the environment gets numbers beyond its bounds",
        provenance="plausible",
        violates=("LOOP-12",),
        fix="Clip to [-1, 1] before scaling to the bounds.",
        edits={
            "training_loop._rescale": {
                "np.clip(part, -1.0, 1.0)": "part",
                "np.clip(lowest + (clipped": "(lowest + (clipped",
                "(highest - lowest), lowest, highest)": "(highest - lowest))",
            }
        },
    ),
    Mutant(
        name="environment_gets_unscaled_actions",
        explanation="the environment gets numbers from [-1, 1], whatever its bounds are",
        provenance="plausible",
        violates=("LOOP-12",),
        fix="Scale [-1, 1] to the bounds.",
        edits={"training_loop._rescale": {"np.where(below | above, rescaled, clipped)": "clipped"}},
    ),
    Mutant(
        name="environment_clips_at_a_single_bound",
        explanation="where a number has one bound only, half of the actions are that bound",
        provenance="plausible: the environment gets [-1, 1] there, and clips it",
        violates=("LOOP-12",),
        fix="Scale [-1, 1] to the range 2 wide at the bound.",
        edits={
            "training_loop._rescale": {
                "np.where(below | above, rescaled, clipped)": (
                    "np.clip(np.where(below & above, rescaled, clipped), low, high)"
                )
            }
        },
    ),
    Mutant(
        name="training_starts_with_a_few_sequences",
        explanation="training starts with as many sequences as a batch has",
        provenance="edition of April 2024 (D-89)",
        violates=("LOOP-13",),
        fix="Wait for batch_size * batch_length start positions.",
        edits={"training_loop.can_train": {"return items >= needed": "return items >= config.batch_size"}},
    ),
    Mutant(
        name="replay_ratio_counts_train_steps",
        explanation="the replay ratio is the number of train steps for each environment step",
        provenance="the meaning of sheeprl's replay_ratio (D-88)",
        violates=("LOOP-14",),
        fix="The ratio counts time steps that are trained on: divide by batch_size * batch_length.",
        edits={"training_loop.ReplayRatio": {"self._batch_steps = batch_steps": "self._batch_steps = 1"}},
    ),
    Mutant(
        name="warmup_is_paid_back",
        explanation="the first call owes train steps for everything that was collected before",
        provenance="plausible; NM512/dreamerv3-torch trains a hundred times at the start (D-89)",
        violates=("LOOP-14",),
        fix="The first call makes one train step, and counting starts there.",
        edits={"training_loop.ReplayRatio": {"self._step: int | None = None": "self._step: int | None = 0"}},
    ),
    Mutant(
        name="fractions_of_train_steps_lost",
        explanation="what is left of a train step is forgotten at every call",
        provenance="plausible: an integer division",
        violates=("LOOP-15",),
        fix="Keep the remainder.",
        edits={"training_loop.ReplayRatio": {"self._credit -= due * self._batch_steps": "self._credit = Fraction(0)"}},
    ),
    Mutant(
        name="replay_ratio_drifts",
        explanation="the ratio is rounded, so that a long run makes too few or too many train steps",
        provenance="plausible: sums of floating-point numbers",
        violates=("LOOP-15",),
        fix="Count with the exact value of the ratio.",
        edits={
            "training_loop.ReplayRatio": {"Fraction(replay_ratio)": "Fraction(replay_ratio).limit_denominator(1000)"}
        },
    ),
    Mutant(
        name="resume_trains_at_once",
        explanation="a resumed run makes another first train step and forgets what it owes",
        provenance="plausible: a counter that is not in the checkpoint",
        violates=("LOOP-23",),
        fix="Save and load step and credit.",
        edits={"training_loop.ReplayRatio": {'None if state["step"] is None else int(state["step"])': "None"}},
    ),
    Mutant(
        name="workers_share_a_seed",
        explanation="all environments have the same seed",
        provenance="plausible; danijar/dreamerv3 leaves most environments unseeded (D-137)",
        violates=("LOOP-25",),
        fix="Derive a seed from seed, purpose and index.",
        edits={"training_loop.derive_seed": {'f"{seed}/{purpose}/{index}"': 'f"{seed}/{purpose}/0"'}},
    ),
    Mutant(
        name="uses_share_a_seed",
        explanation="all uses of randomness have the same seed, so that noise repeats",
        provenance="plausible",
        violates=("LOOP-25",),
        fix="Derive a seed from seed, purpose and index.",
        edits={"training_loop.derive_seed": {'f"{seed}/{purpose}/{index}"': 'f"{seed}//{index}"'}},
    ),
)
