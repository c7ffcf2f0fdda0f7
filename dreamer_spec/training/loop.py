"""The loop of spec/12-training-loop.md: act, remember, learn."""

import time
from collections.abc import Mapping
from contextlib import ExitStack

import numpy as np

from dreamer_spec.backend import Learner
from dreamer_spec.envs import Record, stored
from dreamer_spec.monitoring.logger import Watch
from dreamer_spec.options import Options
from dreamer_spec.system.signals import Stopped, stoppable
from dreamer_spec.training import resume
from dreamer_spec.training.divergence import finite_action, settle
from dreamer_spec.training.evaluation import report_failures
from dreamer_spec.training.schedule import Schedule, evaluation_is_due, finish, log_episode
from dreamer_spec.training.setup import prepare
from dreamer_spec.training.state import TrainingRun, TrainStep
from reference_numpy.training_loop import can_train, derive_seed


def run(options: Options, learner: type[Learner] | None = None, watch: Watch | None = None) -> bool:
    """Trains as the options say, or continues. Returns whether it came to the end; False after Ctrl-C, with a
    checkpoint.

    learner: the class to train instead of the backend's. watch: called with step and metrics of each line that is
    written; if it returns False, the run ends as after Ctrl-C.

    Raises:
      UserError: whatever the user can mend; see dreamer_spec/cli.py.
      Stopped: a signal came before training began, so there was nothing to save.
    """
    with stoppable() as signals, signals.polled(), ExitStack() as stack:
        try:
            with signals.polled(False):
                run = prepare(options, learner, stack, watch)
        except KeyboardInterrupt as error:
            raise Stopped("before training began: there was nothing to save, and nothing is lost") from error
        return train(run) and finish(run)


def train(run: TrainingRun) -> bool:
    """Acts, remembers and learns until the budget of steps is used up. Returns False if Ctrl-C ended it; then a
    checkpoint is written."""
    with stoppable() as signals, signals.polled():
        run.signals = signals.received
        schedule = Schedule(run)
        if not run.shares_environment:
            schedule.evaluate(run)
        while (run.step < run.options.steps or run.counters.due) and not run.interrupted:
            if run.counters.due and (run.record["is_last"].all() or run.step >= run.options.steps):  # [LOOP-65]
                learn(run)
                schedule.attend(run)
                schedule.save(run)
                continue
            lent = run.shares_environment and bool(run.record["is_last"].all()) and evaluation_is_due(run)  # [LOOP-66]
            act(run, wait=lent)
            schedule.attend(run)
            if lent:
                schedule.evaluate(run)
            with run.clock.part("environments"):
                run.record = run.envs.next_episodes() if lent else run.envs.finish()
            report_failures(run.envs, run.display.say)
            schedule.save(run)
        if run.interrupted:
            path = resume.save(run)
            run.display.say(f"{run.ending} at step {run.step:,}, saved in {path}; the same command continues from here")
    return not run.interrupted


def act(run: TrainingRun, wait: bool = False) -> None:
    """One step of the policy in all environments, which then step on while the learner trains; or wait, where their
    episodes have ended."""
    record = run.record
    observation = {key: record[key] for key in run.envs.spaces.observations}
    with run.clock.part("policy"):
        seed = derive_seed(run.options.seed, "policy", run.counters.policy_steps)
        action, latents, run.carry = run.learner.policy(observation, record["is_first"], run.carry, seed)
    run.counters.policy_steps += 1
    action = finite_action(run, action)
    if not wait:
        with run.clock.part("environments"):
            run.envs.start(action)
    remember_and_learn(run, record, action, {name: np.asarray(value) for name, value in latents.items()})
    for worker, score, length in run.scores.update(record):
        log_episode(run, score, length, run.envs.info[worker])


def remember_and_learn(run: TrainingRun, record: Record, action: np.ndarray, latents: Mapping[str, np.ndarray]) -> None:
    """Adds the workers' records one by one, and after each one trains as often as the replay ratio says: [LOOP-4], or
    later: [LOOP-65]."""
    with run.clock.part("replay"):
        packed = run.replay.pack(stored(record, action, latents))
        for worker in range(run.envs.count):
            run.replay.add_packed(packed, worker, worker)
            run.counters.records += 1
            if can_train(len(run.replay), run.options.config):
                run.counters.due += run.ratio(run.counters.records)
            while run.counters.due and run.options.train_when == "always":
                learn(run)


def learn(run: TrainingRun) -> None:
    """One train step. The next batch is drawn meanwhile, and the latents are written back when they are computed:
    [LOOP-17]."""
    with run.clock.part("replay"):
        batch = run.replay.take()
        ids = batch.pop("ids")
    number = run.counters.train_steps
    seed = derive_seed(run.options.seed, "train", number)
    if not run.warm:
        run.display.phase("the first train step" + (", which JAX compiles" if run.options.backend == "jax" else ""))
        run.warm = True
    with run.clock.part("train"):
        called = time.perf_counter()
        metrics, latents = run.learner.train_step(batch, seed)
        # Waits until the step before is computed.
        run.replay.write_back(ids, latents, lambda: run.clock.computed(called), metrics["skipped"])
        settle(run)
    run.counters.train_steps += 1
    run.counters.due -= 1
    run.unsettled = TrainStep(number, seed, batch, metrics)
