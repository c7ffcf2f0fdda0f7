"""A training loop as small as can be, for the checks of running loops: the pseudocode of spec/12-training-loop.md, with
the reference's buffer. It draws and writes back at once, evaluates before it begins, and keeps what it saves in memory.

Mistakes are subclasses: see test_running_checks.py.
"""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.running.interface import RunOptions
from reference_numpy.replay import Replay
from reference_numpy.training_loop import (
    ReplayRatio,
    can_train,
    derive_seed,
    environment_action,
    make_record,
    step_flags,
)

Output = tuple[Any, float, dict[str, bool]]  # observation, reward, flags


class Worker:
    """One environment and the seed of its episodes."""

    def __init__(self, make: Callable[[], Any], seed: int, options: RunOptions) -> None:
        self._make, self._options = make, options
        self.env = make()
        self.seed, self.episodes, self.actions = seed, 0, list[np.ndarray]()

    def reset(self) -> Output:
        seed = derive_seed(self.seed, "episode", self.episodes)
        self.episodes, self.actions = self.episodes + 1, []
        observation, _ = self.env.reset(seed=seed)
        return copy.deepcopy(observation), 0.0, step_flags(True, False, False)

    def step(self, flat: np.ndarray) -> Output:
        self.actions.append(flat)
        total = 0.0
        try:
            for _ in range(self._options.action_repeat):
                action = {key: value[0] for key, value in self.action(flat[None]).items()}
                observation, reward, terminated, truncated, _ = self.env.step(action)
                total += reward
                if terminated or truncated:
                    break
        except Exception:
            return self.replaced()
        return copy.deepcopy(observation), total, step_flags(False, terminated, truncated)

    def action(self, flat: np.ndarray) -> Any:
        return environment_action(flat, self._options.spaces, self.env.low, self.env.high)

    def replaced(self) -> Output:
        self.env, self.seed, self.episodes = self._make(), derive_seed(self.seed, "restart", 0), 0
        return self.reset()

    def back_at(self, seed: int, episodes: int, actions: list[np.ndarray]) -> Output:
        self.seed, self.episodes = seed, episodes - 1
        output = self.reset()
        for flat in actions:
            output = self.step(flat)
        return output


class SmallLoop:
    saved: ClassVar[dict[Path, dict[str, Any]]] = {}
    worker: ClassVar[type[Worker]] = Worker

    def __init__(self, make: Callable[[], Any], learner: Any, options: RunOptions) -> None:
        self.options, self.config, self._make = options, options.config, make
        self.learner = learner(options.spaces, self.config, derive_seed(options.seed, "parameters", 0))
        batch_steps = self.config.batch_size * self.config.batch_length
        self.ratio = ReplayRatio(self.config.replay_ratio, batch_steps)
        self.replay = Replay(self.config.replay_capacity, self.config.batch_length)
        self.counts = dict.fromkeys(("records", "policy", "train", "starts", "evaluations", "evaluation"), 0)
        self.episodes: list[tuple[float, int]] = []
        self.evaluations: list[float] = []

    def run(self) -> dict[str, Any]:
        options, before = self.options, self.saved.get(self.options.directory)
        if before:
            self.load(before)
        else:
            if options.random_episodes:
                self.play_randomly()
            if options.begin_with:
                self.warm_start(self.saved[options.begin_with]["learner"])
            self.begin()
        if options.evaluate_every and not options.shared_environment:
            self.evaluate(self.testers())
        while self.counts["records"] < options.steps:
            self.act_and_learn()
        self.saved[options.directory] = self.save()
        return {"episodes": self.episodes, "evaluations": self.evaluations}

    def play_randomly(self) -> None:
        """Each environment its share of the episodes, [LOOP-26]."""
        rng = np.random.default_rng(derive_seed(self.options.seed, "random_policy", 0))
        for place in range(2):
            seed = derive_seed(self.options.seed, "random_environment", place)
            worker = self.worker(self._make, seed, self.options)
            for _ in range(self.options.random_episodes // 2):
                output = worker.reset()
                while not output[2]["is_last"]:
                    output = worker.step(self.random_action(rng))

    def random_action(self, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(-1, 1, self.options.spaces.action_size).astype(np.float32)

    def begin(self) -> None:
        """Fresh episodes everywhere: [LOOP-26]."""
        count, start = self.config.envs, self.counts["starts"]
        seeds = [derive_seed(self.options.seed, "environment", worker + count * start) for worker in range(count)]
        self.counts["starts"] += 1
        self.workers = [self.worker(self._make, seed, self.options) for seed in seeds]
        self.outputs = [worker.reset() for worker in self.workers]
        self.carry = self.learner.initial_carry(count)
        self.scores = [(0.0, 0)] * count

    def act_and_learn(self) -> None:
        options, every = self.options, self.options.evaluate_every
        action, latents = self.act()
        outputs = self.outputs
        for worker in range(self.config.envs):
            self.remember(worker, action[worker], latents)
            self.counts["records"] += 1
            if can_train(len(self.replay), self.config):
                for _ in range(self.ratio(self.due_at())):
                    self.learn()
        due = every and self.counts["records"] // every > (self.counts["records"] - self.config.envs) // every
        self.waits = getattr(self, "waits", False) or bool(due)
        ended = [output[2]["is_last"] for output in outputs]
        if self.waits and (not options.shared_environment or all(ended)):
            self.waits = False
            self.evaluate(self.lent() if options.shared_environment else self.testers())
        self.outputs = [
            worker.reset() if end else worker.step(flat)
            for worker, end, flat in zip(self.workers, ended, action, strict=True)
        ]

    def due_at(self) -> int:
        return self.counts["records"]

    def act(self) -> tuple[np.ndarray, Any]:
        is_first = np.array([output[2]["is_first"] for output in self.outputs])
        seed = derive_seed(self.options.seed, "policy", self.counts["policy"])
        self.counts["policy"] += 1
        action, latents, self.carry = self.learner.policy(stacked(self.outputs), is_first, self.carry, seed)
        return action, latents

    def remember(self, worker: int, action: np.ndarray, latents: Any) -> None:
        observation, reward, flags = self.outputs[worker]
        onehot = np.eye(self.config.classes)[latents["stoch"][worker]]
        self.replay.add(make_record(observation, reward, flags, action, latents["deter"][worker], onehot), worker)
        total, length = (0.0, 0) if flags["is_first"] else self.scores[worker]
        self.scores[worker] = total + reward, length + 1
        if flags["is_last"]:
            self.episodes.append(self.scores[worker])

    def learn(self) -> None:
        number = self.counts["train"]
        draw = derive_seed(self.options.seed, "replay", number)
        uniform = np.random.Generator(np.random.PCG64(draw)).random(self.config.batch_size)
        batch = self.sample(uniform)
        ids = batch.pop("ids")
        metrics, latents = self.learner.train_step(batch, derive_seed(self.options.seed, "train", number))
        self.counts["train"] += 1
        if not metrics["skipped"]:
            self.replay.write_back(ids, latents)
        else:
            self.met(metrics)

    def sample(self, uniform: np.ndarray) -> Any:
        return self.replay.sample(uniform)

    def met(self, metrics: Any) -> None:
        if self.options.nonfinite == "stop":
            raise FloatingPointError(f"the loss is {metrics['loss/total']}")

    def testers(self) -> list[Worker]:
        first = 2 * self.counts["evaluations"]
        seeds = [derive_seed(self.options.seed, "evaluation_environment", first + worker) for worker in range(2)]
        return [self.worker(self._make, seed, self.options) for seed in seeds]

    def lent(self) -> list[Worker]:
        seed = derive_seed(self.options.seed, "evaluation_environment", self.counts["evaluations"])
        tester = self.worker(lambda: self.workers[0].env, seed, self.options)
        return [tester]

    def evaluate(self, workers: list[Worker]) -> None:
        """The first episodes of each in turn, until there are enough."""
        carry, outputs = self.learner.initial_carry(len(workers)), [worker.reset() for worker in workers]
        scores, totals = list[float](), [0.0] * len(workers)
        while len(scores) < self.options.evaluation_episodes:
            is_first = np.array([output[2]["is_first"] for output in outputs])
            seed = derive_seed(self.options.seed, "evaluation", self.counts["evaluation"])
            self.counts["evaluation"] += 1
            action, _, carry = self.learner.policy(stacked(outputs), is_first, carry, seed)
            for place, worker in enumerate(workers):
                _, reward, flags = outputs[place]
                totals[place] = reward + (0.0 if flags["is_first"] else totals[place])
                scores += [totals[place]] if flags["is_last"] else []
                outputs[place] = worker.reset() if flags["is_last"] else worker.step(action[place])
        self.counts["evaluations"] += 1
        self.evaluations.append(float(np.mean(scores[: self.options.evaluation_episodes])))

    def warm_start(self, state: dict[str, np.ndarray]) -> None:
        taken = {name: array for name, array in state.items() if not name.startswith("optimizer/")}
        self.learner.load_state_dict(self.learner.state_dict() | taken)

    def save(self) -> dict[str, Any]:
        episodes = [(worker.seed, worker.episodes, worker.actions) for worker in self.workers]
        kept = {"outputs": self.outputs, "scores": self.scores, "replay": self.replay, "counts": self.counts}
        carry = self.learner.save_carry(self.carry)
        more = {"carry": carry, "ratio": self.ratio.state_dict(), "under way": episodes}
        return copy.deepcopy({**kept, **more, "learner": self.learner.state_dict()})

    def load(self, saved: dict[str, Any]) -> None:
        saved = copy.deepcopy(saved)
        self.learner.load_state_dict(saved["learner"])
        self.ratio.load_state_dict(saved["ratio"])
        self.counts, self.replay = saved["counts"], saved["replay"]
        self.workers = [self.worker(self._make, 0, self.options) for _ in saved["under way"]]
        outputs = [worker.back_at(*way) for worker, way in zip(self.workers, saved["under way"], strict=True)]
        if all(map(same, outputs, saved["outputs"])):
            self.outputs, self.scores = outputs, saved["scores"]
            self.carry = self.learner.load_carry(saved["carry"])
        else:
            self.replay.load_state_dict(saved["replay"].state_dict())
            self.begin()


def stacked(outputs: list[Output]) -> dict[str, np.ndarray]:
    return {key: np.stack([output[0][key] for output in outputs]) for key in outputs[0][0]}


def same(output: Output, other: Output) -> bool:
    return output[1:] == other[1:] and all(np.array_equal(output[0][key], other[0][key]) for key in other[0])


class Candidate(NumpyAdapter):
    """The reference with a loop."""

    refuses_anyhow = True

    def __init__(self, loop: type[SmallLoop] = SmallLoop) -> None:
        self._loop = loop

    def run(self, environment: Any, learner: Any, options: RunOptions) -> Any:
        return self._loop(environment, learner, options).run()
