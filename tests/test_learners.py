"""Both learners as training uses them: their state, their random numbers, and what one may take over from the other."""

from collections.abc import Mapping

import numpy as np
import pytest
from fake_state import GROUPS
from safetensors.numpy import load, save

from conformance.problems import random_batch, random_observations, random_state, small_config, spaces
from dreamer_spec.backend import Learner, learner_class
from reference_numpy import agent as reference
from spec import Config, Discrete, Spaces, parameter_table

BACKENDS = ("jax", "torch")
ENVS = 6
TASK = spaces("vector", "mixed")
CONFIG = small_config("paper", "float32")

Arrays = dict[str, np.ndarray]


def make(backend: str, seed: int = 0, task: Spaces = TASK, config: Config = CONFIG) -> Learner:
    return learner_class(backend)(task, config, seed=seed, device="cpu")


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def learner(backend: str) -> Learner:
    """One for all tests that only need what they load into it: compiling takes long."""
    return make(backend)


@pytest.fixture(scope="module")
def twin(backend: str) -> Learner:
    """Another, of another seed: what both do alike comes from what is loaded."""
    return make(backend, seed=1)


@pytest.fixture(scope="module")
def fresh(backend: str) -> Arrays:
    """The state that a run with seed 0 begins with."""
    return make(backend).state_dict()


def middle_of_training(config: Config = CONFIG, task: Spaces = TASK) -> Arrays:
    """A state in which no number is zero or one."""
    return reference.flatten_state(random_state(np.random.default_rng(5), config, task, "float32"))


def batch(seed: int, config: Config = CONFIG, task: Spaces = TASK) -> Arrays:
    return random_batch(np.random.default_rng(seed), config, task)


def observation(seed: int, task: Spaces = TASK) -> Arrays:
    return random_observations(np.random.default_rng(seed), task, (ENVS,))


def act(learner: Learner, first: int, calls: int) -> list[np.ndarray]:
    """Everything that some policy steps give, beginning with fresh environments; the number of a step is its seed."""
    carry, results = learner.initial_carry(ENVS), []
    for call in range(first, first + calls):
        action, latents, carry = learner.policy(observation(call), np.arange(ENVS) == call, carry, call)
        results += [np.array(action), *(np.array(latents[name]) for name in ("deter", "stoch"))]
    return results


def train(learner: Learner, first: int, steps: int) -> list[np.ndarray]:
    """Everything that some train steps give; the number of a step is its seed."""
    results = []
    for step in range(first, first + steps):
        metrics, latents = learner.train_step(batch(step), step)
        results += [np.array(float(metrics[name])) for name in sorted(metrics)] + [
            np.array(latents[name]) for name in ("deter", "stoch")
        ]
    return results


def equal(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def assert_same_state(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> None:
    assert set(a) == set(b)
    assert [name for name in a if not np.array_equal(a[name], b[name])] == []


# The state


@pytest.mark.covers("AGT-8", "AGT-9", "AGT-10")
def test_a_state_comes_out_as_it_went_in_through_a_file(learner: Learner) -> None:
    state = middle_of_training()
    learner.load_state_dict(load(save({name: np.array(array, order="C") for name, array in state.items()})))
    assert_same_state(learner.state_dict(), state)


def test_a_state_is_a_copy(learner: Learner) -> None:
    given = middle_of_training()
    learner.load_state_dict(given)
    for array in given.values():
        array[...] = 0
    state = learner.state_dict()
    assert_same_state(state, middle_of_training())
    train(learner, 0, 1)
    act(learner, 0, 1)
    assert_same_state(state, middle_of_training())
    after = learner.state_dict()
    for array in learner.state_dict().values():
        array[...] = 0
    assert_same_state(learner.state_dict(), after)


@pytest.mark.covers("AGT-10")
def test_states_that_do_not_fit_are_refused_and_change_nothing(learner: Learner) -> None:
    learner.load_state_dict(middle_of_training())
    state = learner.state_dict()
    wrong = {
        **state,
        "params/rssm/gru/bias": np.zeros(7, np.float32),
        "optimizer/step": np.zeros(1, np.int64),
        "params/extra": np.zeros(1),
    }
    del wrong["slow_critic/critic/out/bias"]
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the words are below
        learner.load_state_dict(wrong)
    for words in (
        "params/rssm/gru/bias",
        "[7]",
        "[48]",
        "optimizer/step",
        "[1]",
        "params/extra",
        "slow_critic/critic/out/bias",
    ):
        assert words in str(error.value), words
    assert "params/rssm/gru/kernel" not in str(error.value)
    assert_same_state(learner.state_dict(), state)
    transposed = state["params/reward/hidden0/kernel"].T
    with pytest.raises(ValueError, match="reward/hidden0/kernel"):
        learner.load_state_dict({**state, "params/reward/hidden0/kernel": transposed})


# Random numbers


@pytest.mark.covers("CON-16", "LOOP-24")
def test_the_same_seed_gives_the_same_run(learner: Learner, twin: Learner, fresh: Arrays) -> None:
    for one in (learner, twin):
        one.load_state_dict(fresh)
    results = [[*act(one, 0, 2), *train(one, 0, 2), *act(one, 2, 2)] for one in (learner, twin)]
    assert equal(*results)
    assert_same_state(learner.state_dict(), twin.state_dict())


@pytest.mark.covers("AGT-10", "LOOP-23", "LOOP-24", "LOOP-26")
def test_a_resumed_run_goes_on_as_if_it_had_not_stopped(learner: Learner, twin: Learner, fresh: Arrays) -> None:
    learner.load_state_dict(fresh)
    act(learner, 0, 3)
    train(learner, 0, 2)
    saved = learner.state_dict()
    twin.load_state_dict(middle_of_training())  # whatever was there before
    train(twin, 0, 1)
    twin.load_state_dict(saved)
    results = [[*act(one, 3, 2), *train(one, 2, 2), *act(one, 5, 1)] for one in (learner, twin)]
    assert equal(*results)
    assert_same_state(learner.state_dict(), twin.state_dict())


@pytest.mark.covers("AGT-8", "AGT-9", "LOOP-21")
def test_every_part_of_the_state_matters_to_the_next_step(learner: Learner, fresh: Arrays) -> None:
    """So the tests above see it if one is lost: the parameters after a step are others where a fresh part takes its
    place."""
    state, parameters = middle_of_training(), {}
    for lost in ("nothing", *(group for group in GROUPS if group != "params/")):
        learner.load_state_dict(state | {name: array for name, array in fresh.items() if name.startswith(lost)})
        learner.train_step(batch(0), 0)
        after = learner.state_dict()
        parameters[lost] = np.concatenate([after[name].ravel() for name in after if name.startswith("params/")])
    same = [lost for lost, array in parameters.items() if np.array_equal(array, parameters["nothing"])]
    assert same == ["nothing"]


@pytest.mark.covers("CON-21", "LOOP-26")
@pytest.mark.parametrize("step", ["policy", "train"])
def test_every_seed_gives_noise_of_its_own(learner: Learner, fresh: Arrays, step: str) -> None:
    """The same state and the same inputs give other samples under another seed, and the same under the same."""
    samples = []
    for seed in (0, 1, 2**31 - 1, 0):
        learner.load_state_dict(fresh)
        if step == "policy":
            latents = learner.policy(observation(0), np.ones(ENVS, bool), learner.initial_carry(ENVS), seed)[1]
        else:
            latents = learner.train_step(batch(0), seed)[1]
        samples.append(np.array(latents["stoch"]))
    assert np.array_equal(samples[0], samples[3])
    for i, j in ((0, 1), (1, 2), (0, 2)):
        assert np.mean(samples[i] != samples[j]) > 0.5, (
            "nearly uniform samples of 5 classes must differ in 4 of 5 places"
        )


@pytest.mark.covers("CON-21")
def test_the_numbers_of_one_step_are_independent(learner: Learner, fresh: Arrays) -> None:
    """Rows, steps, latents and action dimensions do not share random numbers; means are those of the distributions."""
    outputs = ("params/rssm/posterior/out/kernel", "params/actor/out/")
    learner.load_state_dict(
        {name: np.zeros_like(array) if name.startswith(outputs) else array for name, array in fresh.items()}
    )
    envs = 512
    one = {key: np.repeat(value[:1], envs, 0) for key, value in observation(0).items()}
    action, latents, _ = learner.policy(one, np.ones(envs, bool), learner.initial_carry(envs), 0)
    arm, buttons, stoch = action[:, :2], action[:, 2:], np.asarray(latents["stoch"])
    # With outputs of 0 every class is equally likely, and the normals have mean 0 and this standard deviation.
    std = CONFIG.actor_min_std + (CONFIG.actor_max_std - CONFIG.actor_min_std) / (1 + np.exp(-2))
    columns = [
        arm[:, 0] / std,
        arm[:, 1] / std,
        *(stoch - 2).T / 2**0.5,
        2 * buttons[:, 0] - 1,
        (buttons[:, 2] - 1 / 3) / (2 / 9) ** 0.5,
    ]
    correlation = np.array(columns) @ np.array(columns).T / envs
    assert np.abs(correlation - np.eye(len(columns))).max() < 6 / envs**0.5
    assert np.abs(np.mean(columns, axis=1)).max() < 5 / envs**0.5
    assert len(np.unique(arm)) == arm.size
    assert abs(np.corrcoef(arm[:-1, 0], arm[1:, 0])[0, 1]) < 5 / envs**0.5
    _, trained = learner.train_step({key: np.repeat(value[:1], len(value), 0) for key, value in batch(0).items()}, 0)
    rows = np.asarray(trained["stoch"])
    assert not np.array_equal(rows[0], rows[1]), "rows of a batch share random numbers"
    assert len(np.unique(rows[0], axis=0)) > 2, "steps of a batch share random numbers"


# What does not depend on random numbers


def decided(config: Config, task: Spaces) -> Arrays:
    """A state whose every categorical is certain: samples do not depend on the noise, so that backends can be
    compared."""
    state, rng = middle_of_training(config, task), np.random.default_rng(6)
    classes = {f"rssm/{part}/out": [config.classes] * config.stoch for part in ("posterior", "prior")}
    classes |= {
        f"actor/out/{key}/logits": list(space.classes)
        for key, space in task.actions.items()
        if isinstance(space, Discrete)
    }
    for name, sizes in classes.items():
        state[f"params/{name}/kernel"][...] = 0
        state[f"params/{name}/bias"][...] = np.concatenate([60 * np.eye(size)[rng.integers(size)] for size in sizes])
    return state


DECIDED_TASK = Spaces(spaces("vector", "mixed").observations, spaces("vector", "discrete").actions)
DECIDED_CONFIG = small_config("paper", "float32", latent_unimix=0.0, actor_unimix=0.0)


@pytest.fixture(scope="module")
def decided_learner(backend: str) -> Learner:
    return make(backend, 3, DECIDED_TASK, DECIDED_CONFIG)


@pytest.mark.covers("AGT-10", "AGT-29", "AGT-30")
def test_a_state_of_one_backend_goes_on_in_the_other() -> None:
    """The other takes over every number. Where samples are certain, the next steps agree, and their losses with the
    reference."""
    task, config = DECIDED_TASK, DECIDED_CONFIG
    one, other = (make(backend, seed, task, config) for seed, backend in enumerate(BACKENDS))
    one.load_state_dict(decided(config, task))
    one.train_step(batch(0, config, task), 0)
    for first, second in ((one, other), (other, one)):
        state = first.state_dict()
        second.load_state_dict(state)
        assert_same_state(second.state_dict(), state)
        inputs = batch(int(state["optimizer/step"]), config, task)
        (metrics, latents), (other_metrics, other_latents) = first.train_step(inputs, 1), second.train_step(inputs, 2)
        np.testing.assert_array_equal(latents["stoch"], other_latents["stoch"])
        np.testing.assert_allclose(latents["deter"], other_latents["deter"], atol=1e-5)
        assert set(metrics) == set(other_metrics)
        for name in metrics:
            np.testing.assert_allclose(
                float(metrics[name]), float(other_metrics[name]), rtol=2e-4, atol=2e-5, err_msg=name
            )
        after, other_after = first.state_dict(), second.state_dict()
        assert set(after) == set(other_after)
        for name, value in after.items():
            np.testing.assert_allclose(
                value, other_after[name], rtol=1e-3, atol=1e-3 * np.abs(value).max() + 1e-7, err_msg=name
            )
        before = reference.unflatten_state(state, parameter_table(config, task))
        noise = {
            "posterior": np.full((2, 5, 3), 0.3),
            "prior": np.full((10, 3, 3), 0.6),
            "action": np.full((10, 3, task.action_noise_size), 0.9),
        }
        range_ = (before["return_range"]["low"], before["return_range"]["high"])
        _, aux = reference.losses(before["params"], before["slow_critic"], range_, inputs, noise, task, config)
        for name, value in aux["losses"].items():
            np.testing.assert_allclose(float(metrics[f"loss/{name}"]), value, rtol=1e-3, atol=1e-4, err_msg=name)
        for name, value in aux["metrics"].items():
            np.testing.assert_allclose(float(metrics[name]), value, rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.covers("AGT-11", "CON-12", "LOOP-7", "LOOP-8")
def test_the_policy_carries_latents_and_action_and_resets_rows(decided_learner: Learner) -> None:
    """Steps of several environments as the reference makes them, with resets of single rows in between."""
    task, config, state = DECIDED_TASK, DECIDED_CONFIG, decided(DECIDED_CONFIG, DECIDED_TASK)
    decided_learner.load_state_dict(state)
    params = {name.removeprefix("params/"): value for name, value in state.items() if name.startswith("params/")}
    carry = decided_learner.initial_carry(ENVS)
    expected = {"deter": np.zeros((ENVS, config.deter)), "stoch": np.zeros((ENVS, config.stoch, config.classes))}
    expected_action = np.zeros((ENVS, task.action_size))
    noise = {"posterior": np.full((ENVS, config.stoch), 0.5), "action": np.full((ENVS, task.action_noise_size), 0.5)}
    for step in range(4):
        is_first = np.array([step == 0] * 3 + [False] * 2 + [step == 2])
        action, latents, carry = decided_learner.policy(observation(step), is_first, carry, step)
        expected, expected_action = reference.policy_step(
            params, expected, expected_action, observation(step), is_first, noise, task, config
        )
        np.testing.assert_array_equal(action, expected_action)
        np.testing.assert_allclose(latents["deter"], expected["deter"], atol=1e-5)
        np.testing.assert_array_equal(latents["stoch"], expected["stoch"].argmax(-1))


@pytest.mark.covers("LOOP-1")
def test_the_policy_acts_with_the_newest_parameters(learner: Learner, twin: Learner) -> None:
    assert_acts_with_the_newest_parameters(learner, twin, CONFIG)


@pytest.mark.covers("LOOP-1")
def test_the_policy_acts_with_the_newest_parameters_in_bfloat16() -> None:
    """PyTorch keeps its kernels in the compute dtype between train steps, and here that is a copy of every one."""
    config = small_config("paper", "bfloat16", learning_rate=0.1)  # so that a step moves a bfloat16
    assert_acts_with_the_newest_parameters(*(make("torch", seed, TASK, config) for seed in (0, 1)), config)


def assert_acts_with_the_newest_parameters(learner: Learner, twin: Learner, config: Config) -> None:
    """The learner acts, trains and acts with one seed and one carry. Nothing is loaded in between, which would clear
    whatever it keeps of its parameters."""
    learner.load_state_dict(middle_of_training(config))
    before = act(learner, 0, 1)
    for step in range(2):
        learner.train_step(batch(step, config), step)
        after = act(learner, 0, 1)
        twin.load_state_dict(learner.state_dict())
        assert equal(after, act(twin, 0, 1))
        assert not np.array_equal(after[0], before[0]), "a train step must move the actions"
        assert not np.array_equal(after[1], before[1]), "a train step must move the latents"
        before = after


@pytest.mark.covers("CON-5")
def test_the_first_carry_is_that_of_a_reset(learner: Learner) -> None:
    results = []
    for is_first in (True, False):
        learner.load_state_dict(middle_of_training())
        action, latents, _ = learner.policy(observation(0), np.full(ENVS, is_first), learner.initial_carry(ENVS), 0)
        results.append([np.array(action), np.array(latents["deter"]), np.array(latents["stoch"])])
    assert equal(*results)


def test_what_a_learner_returns(learner: Learner) -> None:
    learner.load_state_dict(middle_of_training())
    action, latents, _ = learner.policy(observation(0), np.zeros(ENVS, bool), learner.initial_carry(ENVS), 0)
    assert (action.shape, action.dtype) == ((ENVS, TASK.action_size), np.float32)
    assert (np.shape(latents["deter"]), np.asarray(latents["deter"]).dtype) == ((ENVS, CONFIG.deter), np.float32)
    assert np.shape(latents["stoch"]) == (ENVS, CONFIG.stoch)
    inputs = batch(0)
    before = {name: array.copy() for name, array in inputs.items()}
    metrics, latents = learner.train_step(inputs, 0)
    for name, value in metrics.items():
        assert np.asarray(value).shape == (), name
        assert np.isfinite(float(value)), name
        assert float(value) == float(np.asarray(value)), name
    assert {"loss/reward", "loss/actor", "loss/critic", "loss/replay_critic"} <= set(metrics)
    shape = (CONFIG.batch_size, CONFIG.batch_length)
    assert (np.shape(latents["deter"]), np.asarray(latents["deter"]).dtype) == ((*shape, CONFIG.deter), np.float32)
    assert np.shape(latents["stoch"]) == (*shape, CONFIG.stoch)
    assert np.asarray(latents["stoch"]).dtype.kind in "iu"
    assert np.asarray(latents["stoch"]).max() < CONFIG.classes
    assert_same_state(inputs, before)
