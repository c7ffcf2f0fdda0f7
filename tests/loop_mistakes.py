"""Loops with a mistake each, for the checks of running loops: MISTAKES says which check finds which."""

import copy
from typing import Any

import numpy as np
from small_loop import Output, SmallLoop, Worker

from reference_numpy.training_loop import derive_seed, step_flags


def loop_with(**methods: Any) -> type[SmallLoop]:
    return type("Changed", (SmallLoop,), methods)


def worker_with(**methods: Any) -> type[SmallLoop]:
    return loop_with(worker=type("ChangedWorker", (Worker,), methods))


# What is recorded


def swallows_last_observations(self: Worker, flat: np.ndarray) -> Output:
    """As an automatic reset in the same step does."""
    output = Worker.step(self, flat)
    return self.reset() if output[2]["is_last"] else output


def first_after_the_reset(self: Worker, flat: np.ndarray) -> Output:
    observation, reward, flags = Worker.step(self, flat)
    return observation, reward, {**flags, "is_first": flags["is_first"] or len(self.actions) == 1}


class OneCarryForAll(SmallLoop):
    """Every worker goes on with the carry of the first."""

    def act(self) -> Any:
        result = super().act()
        self.carry = {"stamp": np.full_like(self.carry["stamp"], self.carry["stamp"][0])}
        return result


class CarryIsLost(SmallLoop):
    """Where one worker is reset, all begin with a fresh carry."""

    def act(self) -> Any:
        if any(output[2]["is_first"] for output in self.outputs):
            self.carry = self.learner.initial_carry(self.config.envs)
        return super().act()


def unclipped(self: Worker, flat: np.ndarray) -> Any:
    action = Worker.action(self, flat)
    return {**action, "turn": flat[:, -1:].astype(np.float64)}


class StoresWhatTheEnvironmentGot(SmallLoop):
    def remember(self, worker: int, action: np.ndarray, latents: Any) -> None:
        super().remember(worker, np.clip(action, -1, 1), latents)


class RewardAtTheReset(SmallLoop):
    """The reward of the last step is stored once more with the reset."""

    def remember(self, worker: int, action: np.ndarray, latents: Any) -> None:
        observation, reward, flags = self.outputs[worker]
        record = {**observation, **flags, "action": action, "reward": reward + flags["is_first"]}
        latent = {name: array[worker] for name, array in latents.items()}
        self.replay.add({**record, **latent}, worker)


class LastFlagIsAGuess(SmallLoop):
    def sample(self, uniform: np.ndarray) -> Any:
        batch = super().sample(uniform)
        batch["is_last"] |= np.roll(batch["is_first"], -1, 1)
        return batch


class TruncationIsTerminal(SmallLoop):
    def sample(self, uniform: np.ndarray) -> Any:
        batch = super().sample(uniform)
        return {**batch, "is_terminal": batch["is_last"].copy()}


class ActionOfTheSameStep(SmallLoop):
    def sample(self, uniform: np.ndarray) -> Any:
        batch = super().sample(uniform)
        return {**batch, "prev_action": np.roll(batch["prev_action"], -1, 1)}


class LatentsOfTheStepBefore(SmallLoop):
    """What the policy step returned for the observation before is stored with this one."""

    def remember(self, worker: int, action: np.ndarray, latents: Any) -> None:
        before = getattr(self, "before", latents)
        super().remember(worker, action, before)
        if worker == self.config.envs - 1:
            self.before = latents


class NothingIsWrittenBack(SmallLoop):
    def learn(self) -> None:
        before = self.replay.write_back
        self.replay.write_back = lambda *_: None  # type: ignore[method-assign]
        super().learn()
        self.replay.write_back = before  # type: ignore[method-assign]


class WrittenBackTwoStepsLate(SmallLoop):
    def learn(self) -> None:
        late: list[Any] = getattr(self, "late", [])
        self.late, before = late, self.replay.write_back
        self.replay.write_back = lambda *given: late.append(given)  # type: ignore[method-assign]
        super().learn()
        self.replay.write_back = before  # type: ignore[method-assign]
        if len(late) > 2:
            before(*late.pop(0))


class CoarseLatents(SmallLoop):
    """The stored memory is cut off to bfloat16."""

    def sample(self, uniform: np.ndarray) -> Any:
        batch = super().sample(uniform)
        cut_off = (batch["deter"].view(np.uint32) & np.uint32(0xFFFF0000)).view(np.float32)
        return {**batch, "deter": cut_off}


# When it trains, and with which numbers


class PaysForRepeatedActions(SmallLoop):
    def due_at(self) -> int:
        return self.counts["records"] * self.options.action_repeat


class TrainsBetweenPolicySteps(SmallLoop):
    """As often as is due for whole policy steps: the first train steps come late."""

    def due_at(self) -> int:
        return self.counts["records"] // self.config.envs * self.config.envs


class SharedSeeds(SmallLoop):
    """Train step k has the noise of policy step k."""

    def learn(self) -> None:
        train_step = self.learner.train_step
        seed = derive_seed(self.options.seed, "policy", self.counts["train"])
        self.learner.train_step = lambda batch, _: train_step(batch, seed)
        super().learn()
        self.learner.train_step = train_step


class DrawsWithTheNumbersBefore(SmallLoop):
    def sample(self, uniform: np.ndarray) -> Any:
        before = getattr(self, "uniform", uniform)
        self.uniform = uniform
        return super().sample(before)


class NeverOnline(SmallLoop):
    def sample(self, uniform: np.ndarray) -> Any:
        return self.replay.sample(uniform, online=False)


def the_same_episode(self: Worker) -> Output:
    self.episodes = 0
    return Worker.reset(self)


class UnseededPolicy(SmallLoop):
    def act(self) -> Any:
        policy = self.learner.policy
        self.learner.policy = lambda *given: policy(*given[:3], np.random.default_rng().integers(2**31))
        result = super().act()
        self.learner.policy = policy
        return result


class WritesBackWhatWasSkipped(SmallLoop):
    def learn(self) -> None:
        train_step = self.learner.train_step

        def as_if_made(*given: Any) -> Any:
            metrics, latents = train_step(*given)
            return {**metrics, "skipped": 0.0}, latents

        self.learner.train_step = as_if_made
        super().learn()
        self.learner.train_step = train_step


class GoesOnRegardless(SmallLoop):
    def met(self, metrics: Any) -> None:
        pass


def repeats_past_the_end(self: Worker, flat: np.ndarray) -> Output:
    action, total = {key: value[0] for key, value in self.action(flat[None]).items()}, 0.0
    for _ in range(self._options.action_repeat):
        observation, reward, terminated, truncated, _ = self.env.step(action)
        total += reward
    return copy.deepcopy(observation), total, step_flags(False, terminated, truncated)


def one_array_for_all_frames(self: Worker, flat: np.ndarray) -> Output:
    """What the environment has written into its action is played on the frames that follow."""
    action = {key: value[0] for key, value in self.action(flat[None]).items()}
    self.action = lambda _: {key: value[None] for key, value in action.items()}  # type: ignore[method-assign]
    try:
        return Worker.step(self, flat)
    finally:
        del self.action


def last_reward_alone(self: Worker, flat: np.ndarray) -> Output:
    observation, _, flags = Worker.step(self, flat)
    return observation, 0.25, flags


class ClippedScores(SmallLoop):
    def run(self) -> Any:
        result = super().run()
        return {**result, "episodes": [(np.sign(score), length) for score, length in result["episodes"]]}


# Evaluation, and what goes on


class EvaluationAdvancesTraining(SmallLoop):
    """The policy steps of evaluation are counted as those of training."""

    def evaluate(self, workers: list[Worker]) -> None:
        before = self.counts["evaluation"]
        super().evaluate(workers)
        self.counts["policy"] += self.counts["evaluation"] - before


class EvaluationForgetsItsCarry(SmallLoop):
    def evaluate(self, workers: list[Worker]) -> None:
        policy, fresh = self.learner.policy, self.learner.initial_carry(len(workers))
        self.learner.policy = lambda observation, is_first, _, seed: policy(observation, is_first, fresh, seed)
        super().evaluate(workers)
        self.learner.policy = policy


class EvaluationsAlike(SmallLoop):
    def testers(self) -> list[Worker]:
        seeds = [derive_seed(self.options.seed, "evaluation_environment", worker) for worker in range(2)]
        return [Worker(self._make, seed, self.options) for seed in seeds]


class OverlappingEvaluations(SmallLoop):
    def testers(self) -> list[Worker]:
        first = self.counts["evaluations"]
        seeds = [derive_seed(self.options.seed, "evaluation_environment", first + worker) for worker in range(2)]
        return [Worker(self._make, seed, self.options) for seed in seeds]


class NoiseOfTheFirstEvaluation(SmallLoop):
    def evaluate(self, workers: list[Worker]) -> None:
        self.counts["evaluation"] = 0
        super().evaluate(workers)


class RandomActionsOfOneSeed(SmallLoop):
    """Every environment gets the same actions."""

    def random_action(self, rng: np.random.Generator) -> np.ndarray:
        return super().random_action(np.random.default_rng(0))


class MeansOfRewards(SmallLoop):
    def evaluate(self, workers: list[Worker]) -> None:
        super().evaluate(workers)
        self.evaluations[-1] *= 0.99


class PlaysOnWhereItWas(SmallLoop):
    """After an evaluation in the environment of training, the episode before it is played again."""

    def evaluate(self, workers: list[Worker]) -> None:
        super().evaluate(workers)
        self.workers[0].episodes -= 1


class ForgetsOnLoading(SmallLoop):
    """What `load` loses is what `lose` does."""

    def load(self, saved: dict[str, Any]) -> None:
        super().load(saved)
        self.lose()

    def lose(self) -> None:
        self.carry = self.learner.initial_carry(self.config.envs)


class ForgetsItsCredit(ForgetsOnLoading):
    def lose(self) -> None:
        self.ratio.load_state_dict({"step": None, "credit": "0"})


class ForgetsItsQueue(ForgetsOnLoading):
    def lose(self) -> None:
        self.replay._queue.clear()


class CountsNoStarts(ForgetsOnLoading):
    def load(self, saved: dict[str, Any]) -> None:
        super().load({**saved, "counts": {**saved["counts"], "starts": 0}})

    def lose(self) -> None:
        pass


class GoesOnWithItsStreams(SmallLoop):
    """New episodes are stored behind those that were left."""

    def load(self, saved: dict[str, Any]) -> None:
        super().load(saved)
        self.replay = copy.deepcopy(saved["replay"])


class TakesTheOptimizerToo(SmallLoop):
    def warm_start(self, state: dict[str, np.ndarray]) -> None:
        self.learner.load_state_dict(state)


class FreshSlowCritic(SmallLoop):
    def warm_start(self, state: dict[str, np.ndarray]) -> None:
        slow = {name: array for name, array in self.learner.state_dict().items() if name.startswith("slow_critic/")}
        super().warm_start({**state, **slow})


def seed_of_before(self: Worker) -> Output:
    self.env = self._make()
    return self.reset()


def as_if_nothing_had_failed(self: Worker) -> Output:
    observation, reward, flags = Worker.replaced(self)
    return observation, reward, {**flags, "is_first": False}


MISTAKES: dict[str, tuple[type[SmallLoop], ...]] = {
    "running_loop.every_observation_acts_once_in_its_order": (
        worker_with(step=swallows_last_observations),
        worker_with(step=first_after_the_reset),
    ),
    "running_loop.each_worker_goes_on_with_its_own_carry": (OneCarryForAll, CarryIsLost),
    "running_loop.environments_get_the_action_of_their_own_row": (worker_with(action=unclipped),),
    "running_loop.batches_hold_what_happened": (
        StoresWhatTheEnvironmentGot,
        RewardAtTheReset,
        LastFlagIsAGuess,
        TruncationIsTerminal,
        ActionOfTheSameStep,
    ),
    "running_loop.latents_are_written_back_in_time": (
        LatentsOfTheStepBefore,
        NothingIsWrittenBack,
        WrittenBackTwoStepsLate,
        CoarseLatents,
    ),
    "running_loop.train_steps_are_counted_exactly": (PaysForRepeatedActions,),
    "running_loop.seeds_are_those_of_the_tables": (SharedSeeds, worker_with(reset=the_same_episode)),
    "running_loop.batches_are_drawn_as_their_seeds_say": (
        DrawsWithTheNumbersBefore,
        NeverOnline,
        TrainsBetweenPolicySteps,
    ),
    "running_loop.actions_are_repeated": (
        worker_with(step=repeats_past_the_end),
        worker_with(step=last_reward_alone),
        worker_with(step=one_array_for_all_frames),
    ),
    "running_loop.a_seed_determines_the_run": (UnseededPolicy,),
    "running_loop.a_skipped_step_leaves_the_buffer_as_it_is": (WritesBackWhatWasSkipped,),
    "running_loop.a_skipped_step_stops_the_run": (GoesOnRegardless,),
    "running_loop.scores_are_plain_sums": (ClippedScores,),
    "going_on.evaluation_changes_nothing": (EvaluationAdvancesTraining, EvaluationForgetsItsCarry),
    "going_on.a_shared_environment_changes_nothing": (PlaysOnWhereItWas,),
    "going_on.evaluations_play_new_episodes_with_fresh_noise": (
        EvaluationsAlike,
        OverlappingEvaluations,
        NoiseOfTheFirstEvaluation,
    ),
    "going_on.evaluations_have_the_seeds_of_the_tables": (EvaluationsAlike, NoiseOfTheFirstEvaluation),
    "going_on.the_random_policy_draws_for_every_environment": (RandomActionsOfOneSeed,),
    "going_on.an_evaluation_is_the_mean_of_whole_episodes": (MeansOfRewards,),
    "going_on.a_continued_run_is_the_run_in_one_go": (ForgetsOnLoading, ForgetsItsCredit, ForgetsItsQueue),
    "going_on.environments_that_lead_elsewhere_begin_anew": (ForgetsItsCredit, CountsNoStarts, GoesOnWithItsStreams),
    "going_on.environments_that_begin_anew_have_the_seeds_of_their_start": (CountsNoStarts,),
    "going_on.a_warm_start_takes_over_what_was_learned": (TakesTheOptimizerToo, FreshSlowCritic),
    "going_on.a_failed_environment_is_replaced": (worker_with(replaced=as_if_nothing_had_failed),),
    "going_on.a_replaced_environment_has_the_seed_of_its_restart": (worker_with(replaced=seed_of_before),),
}
