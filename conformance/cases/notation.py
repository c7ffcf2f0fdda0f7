"""Checks of spec/00-notation.md: conventions that every row shares. Most of them are also seen by the checks of the
rows themselves."""

from typing import Any

import numpy as np

from conformance.check import Run, check, round_to
from conformance.problems import (
    Problem,
    action_noise,
    make_problem,
    random_carry,
    random_observations,
    random_parameters,
    random_state,
    small_config,
    uniforms,
)
from reference_numpy import agent as reference_agent
from reference_numpy import behavior as reference_behavior
from reference_numpy import networks as reference_networks
from reference_numpy import optimizer as reference_optimizer
from spec import Discrete, Spaces, Vector, parameter_table

WHOLE = ("float64", "float32")
EXAMPLE = Spaces({"x": Vector(1)}, {"turn": Vector(2), "buttons": Discrete((2, 3))})
# Sorted by code point: "-z", "0", "B", "_", "a", "b".
ODD_KEYS = Spaces(
    {"b": Vector(2), "B": Discrete((3,)), "_": Vector(1), "-z": Vector(3)},
    {"b": Discrete((2, 3)), "a": Vector(1), "B": Vector(2), "0": Discrete((4,))},
)
# Every number that losses read, different from all profiles.
LOSS_NUMBERS: dict[str, Any] = {
    "norm_epsilon": 0.05, "bins": 21, "latent_unimix": 0.07, "actor_unimix": 0.05, "actor_min_std": 0.3,
    "actor_max_std": 0.8, "encoder_layers": 2, "decoder_layers": 2, "posterior_layers": 2, "prior_layers": 1,
    "reward_layers": 2, "continue_layers": 2, "actor_layers": 2, "critic_layers": 2, "blocks": 4,
    "cnn_multipliers": (2, 3, 4), "reconstruction_scale": 0.9, "reward_scale": 1.3, "continue_scale": 0.7,
    "dynamics_scale": 0.6, "representation_scale": 0.35, "free_nats": 1.5, "vector_loss_scale": 0.77,
    "imagination_horizon": 4, "discount_horizon": 20.0, "return_lambda": 0.8, "actor_scale": 1.2,
    "critic_scale": 0.8, "replay_critic_scale": 0.45, "slow_critic_scale": 0.65, "entropy_scale": 0.05,
    "return_percentile_low": 20.0, "return_percentile_high": 70.0, "return_decay": 0.5, "return_limit": 1e4,
}  # fmt: skip
OPTIMIZER_NUMBERS = {
    "learning_rate": 0.003, "warmup_steps": 25, "agc_clip": 0.02, "agc_epsilon": 0.5, "beta1": 0.8, "beta2": 0.95,
    "laprop_epsilon": 0.1, "slow_critic_decay": 0.9,
}  # fmt: skip


def policy_arguments(run: Run, task: Spaces, rows: int) -> dict[str, Any]:
    """Keyword arguments of `policy_step`, in its order."""
    rng, config = run.rng(), small_config(run.profile, run.dtype)
    return {
        "params": random_parameters(rng, config, task, run.dtype),
        "carry": random_carry(rng, config, (rows,)),
        "prev_action": np.zeros((rows, task.action_size)),
        "observation": random_observations(rng, task, (rows,)),
        "is_first": np.arange(rows) % 4 == 0,
        "noise": {"posterior": uniforms(rng, rows, config.stoch), "action": action_noise(rng, task, (rows,))},
        "spaces": task,
        "config": config,
    }


@check("CON-18", "CON-19", "CON-26", "CON-27", "BEH-8", uses=["sample_action"], level=0)
def the_flat_action_of_the_chapter(run: Run) -> None:
    """Buttons (1, 0) and turn (0.5, -2.0) are the flat action (0, 1, 1, 0, 0, 0.5, -2.0), sampled from two uniforms,
    then two normals."""
    config = small_config(run.profile, run.dtype, actor_unimix=0.0)
    lowest, highest = config.actor_min_std, config.actor_max_std
    std = lowest + (highest - lowest) / (1 + np.exp(-2.0))
    outputs = {
        "turn": {"mean": np.zeros((1, 2)), "std": np.zeros((1, 2))},
        "buttons": {"logits": run.cast([[0, 1, 2, 1, 0]])},
    }
    noise = np.array([[0.5, 0.25, 0.5 / std, -2.0 / std]])
    run.expect(
        "sample_action",
        (outputs, noise, EXAMPLE, config),
        np.array([[0, 1, 1, 0, 0, 0.5, -2]]),
        magnitude=1.0,
        factor=4,
    )


@check("CON-25", "CON-26", "NET-3", "BEH-8", uses=["sample_action", "encoder"], level=1)
def keys_are_walked_in_sorted_order(run: Run) -> None:
    """Signs before digits, capitals, "_" and small letters, in whatever order the mappings hold them."""
    rng, config = run.rng(), small_config(run.profile, run.dtype)
    outputs: dict[str, dict[str, np.ndarray]] = {}
    for key in reversed(list(ODD_KEYS.actions)):
        space = ODD_KEYS.actions[key]
        names = ("logits",) if isinstance(space, Discrete) else ("mean", "std")
        outputs[key] = {name: run.cast(rng.normal(size=(6, space.encoded_size))) for name in names}
    noise = action_noise(rng, ODD_KEYS, (6,))
    expected = reference_behavior.sample_action(outputs, noise, ODD_KEYS, config)
    run.expect("sample_action", (outputs, noise, ODD_KEYS, config), expected, magnitude=5.0)
    params, observation = random_parameters(rng, config, ODD_KEYS, run.dtype), random_observations(rng, ODD_KEYS, (3,))
    backwards = {key: observation[key] for key in reversed(observation)}
    expected = reference_networks.encoder(params, observation, ODD_KEYS, config)
    run.expect("encoder", (params, backwards, ODD_KEYS, config), expected, magnitude="tensor", factor=8)


@check("CON-16", uses=["policy_step"], level=1)
def samples_come_from_the_noise_alone(run: Run) -> None:
    """The same noise gives the same latents and actions again; other noise gives others."""
    arguments = policy_arguments(run, EXAMPLE, 32)
    first, again = (run.call("policy_step", *arguments.values()) for _ in range(2))
    run.exact("action", again[1], first[1])
    run.exact("stoch", again[0]["stoch"], first[0]["stoch"])
    rng, noise = np.random.default_rng(run.seed + 1), arguments["noise"]
    for name, other in {
        "posterior": uniforms(rng, *noise["posterior"].shape),
        "action": action_noise(rng, EXAMPLE, (32,)),
    }.items():
        carry, action = run.call("policy_step", *{**arguments, "noise": {**noise, name: other}}.values())
        if name == "posterior":
            run.holds(
                "other noise gives other latents", np.mean(np.any(carry["stoch"] != first[0]["stoch"], (1, 2))) > 0.5
            )
        else:
            run.exact("latents do not depend on the noise of the action", carry["stoch"], first[0]["stoch"])
            run.holds("other noise gives other numbers", np.asarray(action)[:, 5:] != np.asarray(first[1])[:, 5:])
            run.holds(
                "other noise gives other choices", np.any(np.asarray(action)[:, :5] != np.asarray(first[1])[:, :5])
            )


@check("CON-28", "NET-27", uses=["encoder"], level=1)
def scalars_have_an_axis(run: Run) -> None:
    """A scalar observation is a Vector of size 1 or a Discrete with one entry; without its axis it is refused."""
    task, config = (
        Spaces({"speed": Vector(1), "gear": Discrete((3,))}, {"a": Vector(1)}),
        small_config(run.profile, run.dtype),
    )
    params, observation = (
        random_parameters(run.rng(), config, task, run.dtype),
        random_observations(run.rng(), task, (4,)),
    )
    expected = reference_networks.encoder(params, observation, task, config)
    run.expect("encoder", (params, observation, task, config), expected, magnitude="tensor", factor=8)
    for key in task.observations:
        run.refuses("encoder", params, {**observation, key: observation[key][:, 0]}, task, config)


@check("CON-31", uses=["reward_head", "critic"], level=1)
def parameters_have_full_names(run: Run) -> None:
    """A part finds its parameters by full name, in the mapping of all of them as in one that holds nothing else."""
    task, config = EXAMPLE, small_config(run.profile, run.dtype)
    params = random_parameters(run.rng(), config, task, run.dtype)
    feature = run.cast(run.rng().normal(size=(4, config.feature_size)))
    for function, prefix in (("reward_head", "reward/"), ("critic", "critic/")):
        alone = {name: value for name, value in params.items() if name.startswith(prefix)}
        everything = run.call(function, params, feature, config)
        run.exact(function, run.call(function, alone, feature, config), everything)
        moved = {name: value if name.startswith(prefix) else value + 1 for name, value in params.items()}
        run.exact(f"{function} with other parameters elsewhere", run.call(function, moved, feature, config), everything)


@check("CON-29", "CON-30", uses=["gradients"], level=2, dtypes=WHOLE)
def gradients_have_the_names_and_shapes_of_the_table(run: Run) -> None:
    """One array for each canonical name, in the canonical layout."""
    problem = make_problem(run.seed, run.profile, "both", "mixed", run.dtype)
    gradients = run.call("gradients", *problem.loss_arguments)
    table = parameter_table(problem.config, problem.spaces)
    run.holds("the names of the table", set(gradients) == set(table))
    run.holds("the shapes of the table", [np.shape(gradients[name]) == entry.shape for name, entry in table.items()])


@check("CON-29", "CON-30", uses=["initial_parameters"], level=1, dtypes=WHOLE)
def parameters_have_the_names_and_shapes_of_the_table(run: Run) -> None:
    """A flat mapping from canonical names to arrays in the canonical layouts; convolution kernels are [5, 5, in,
    out]."""
    problem = make_problem(run.seed, run.profile, "both", "mixed", run.dtype)
    table = parameter_table(problem.config, problem.spaces)
    drawn = {
        name: np.full(entry.shape, 0.25) for name, entry in table.items() if entry.initializer == "truncated_normal"
    }
    params = run.call("initial_parameters", table, drawn)
    run.holds("the names of the table", set(params) == set(table))
    run.holds("the shapes of the table", [np.shape(params[name]) == entry.shape for name, entry in table.items()])


def odd_problem(run: Run, observation: str, action: str) -> Problem:
    """Numbers of its own throughout, and each choice other than in the profile."""
    plain = small_config(run.profile, run.dtype)
    choices = {
        "continue_target": "discounted" if plain.continue_target == "hard" else "hard",
        "start_continue": "predicted" if plain.start_continue == "true" else "true",
        "cnn_sampling": "pooled" if plain.cnn_sampling == "strided" else "strided",
        "cnn_outer": not plain.cnn_outer,
    }
    sizes = {"units": 12, "deter": 24, "stoch": 4, "classes": 3, "cnn_depth": 1, "batch_size": 3, "batch_length": 4}
    return make_problem(
        run.seed,
        run.profile,
        observation,
        action,
        run.dtype,
        **{**LOSS_NUMBERS, **OPTIMIZER_NUMBERS, **choices, **sizes},
    )


@check("CON-32", uses=["losses"], level=2, dtypes=("float64",))
def losses_take_every_number_from_the_configuration(run: Run) -> None:
    """Losses agree where no number and no choice is that of a profile."""
    problem = odd_problem(run, "both", "mixed")
    total, aux = reference_agent.losses(*problem.loss_arguments)
    actual_total, actual = run.call("losses", *problem.loss_arguments)
    run.compare(
        "losses", actual["losses"], aux["losses"], magnitude=max(1.0, *map(abs, aux["losses"].values())), bound=1e-9
    )
    run.compare("return_range", tuple(actual["return_range"]), aux["return_range"], magnitude=1.0, bound=1e-9)
    run.compare("total", actual_total, total, bound=1e-9)


@check("CON-32", uses=["optimizer_step"], level=3)
def the_optimizer_takes_every_number_from_the_configuration(run: Run) -> None:
    """Updates agree where no number is that of a profile."""
    config = small_config(run.profile, "float64" if run.dtype == "float64" else "float32", **OPTIMIZER_NUMBERS)
    state = random_state(run.rng(), config, EXAMPLE, run.dtype)
    gradients = {name: round_to(value[::-1] * 10, "float32") for name, value in state["params"].items()}
    expected, expected_state = reference_optimizer.optimizer_step(
        state["params"], gradients, state["optimizer"], config
    )
    actual, actual_state = run.call("optimizer_step", state["params"], gradients, state["optimizer"], config)
    bound = 1e-12 if run.dtype == "float64" else 2e-5
    run.compare("params", dict(actual), expected, magnitude=1.0, bound=bound)
    for moment in ("second_moment", "momentum"):
        run.compare(moment, dict(actual_state[moment]), expected_state[moment], magnitude="tensor", bound=bound)


def step_agrees(run: Run, problem: Problem, gradients: Any, actual: Any) -> None:
    state = problem.state
    expected = reference_agent.train_step(
        state, problem.batch, problem.noise, gradients, problem.spaces, problem.config
    )[0]
    for group in ("params", "slow_critic"):
        run.compare(group, dict(actual[group]), expected[group], magnitude=1.0, bound=1e-9)
    run.compare(
        "momentum", dict(actual["optimizer"]["momentum"]), expected["optimizer"]["momentum"], magnitude=1.0, bound=1e-8
    )


@check("CON-32", uses=["train_step", "gradients"], level=3, dtypes=("float64",))
def a_step_takes_every_number_from_the_configuration(run: Run) -> None:
    """Parameters, momentum and slow critic agree after a step where no number is that of a profile."""
    problem = odd_problem(run, "vector", "mixed")
    gradients = run.call("gradients", *problem.loss_arguments)
    actual = run.call("train_step", problem.state, problem.batch, problem.noise, problem.spaces, problem.config)[0]
    step_agrees(run, problem, gradients, actual)


@check("CON-32", uses=["train_step_with"], level=3, dtypes=("float64",))
def a_step_with_given_gradients_takes_every_number_from_the_configuration(run: Run) -> None:
    """The same with given gradients."""
    problem = odd_problem(run, "vector", "mixed")
    gradients = {name: value[::-1] * 10 for name, value in problem.state["params"].items()}
    actual = run.call(
        "train_step_with", problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config
    )[0]
    step_agrees(run, problem, gradients, actual)


def share_in_bfloat16(value: Any) -> float:
    """Share of the numbers other than 0 that bfloat16 can hold: about 1 in 65 000 of those that were computed in
    float32."""
    numbers = np.asarray(value, np.float64).ravel()
    numbers = numbers[numbers != 0]
    return float(np.mean(numbers == round_to(numbers, "bfloat16"))) if numbers.size else 0.0


# Their rows belong to classes: the gradient of one that occurs once is a single activation's, in bfloat16.
KERNELS_OF_ONEHOTS = ("rssm/embed_stoch/kernel", "decoder/image/stoch_hidden/kernel")


def is_long_sum(name: str, gradient: Any) -> bool:
    """Whether some number of this gradient has more digits than bfloat16 unless it was rounded: it sums over many rows.

    A few numbers can be short by chance, unless they sum over pixels. Kernels of convolutions are left out: they MAY be
    rounded.
    """
    if np.ndim(gradient) == 4 or name in KERNELS_OF_ONEHOTS:
        return False
    return np.size(gradient) >= 8 or (np.size(gradient) > 2 and name.startswith(("encoder/image/", "decoder/image/")))


@check("CON-22", "CON-23", uses=["train_step", "gradients"], level=3, dtypes=("bfloat16",))
def what_must_be_float32_is_float32(run: Run) -> None:
    """With activations in bfloat16: losses, return range, gradients and everything that a step keeps have more digits
    than bfloat16."""
    for observation, action in (("vector", "continuous"), ("both", "mixed")):
        has_the_digits_of_float32(run, make_problem(run.seed, run.profile, observation, action, "bfloat16"))


def has_the_digits_of_float32(run: Run, problem: Problem) -> None:
    state, aux = run.call("train_step", problem.state, problem.batch, problem.noise, problem.spaces, problem.config)
    moments = {name: state["optimizer"][name] for name in ("momentum", "second_moment")}
    groups = {"params": state["params"], "slow_critic": state["slow_critic"], **moments}
    for where, group in groups.items():
        run.holds(
            f"{where} have the digits of float32",
            share_in_bfloat16(np.concatenate([np.ravel(x) for x in group.values()])) < 0.1,
        )
    for name, gradient in run.call("gradients", *problem.loss_arguments).items():
        if is_long_sum(name, gradient):
            run.holds(f"the gradient of {name} has the digits of float32", share_in_bfloat16(gradient) < 0.75)
    values = [aux["losses"][name] for name in ("reward", "continue", "actor", "critic", "replay_critic")]
    values += [
        aux["metrics"][name] for name in ("return_mean", "value_mean", "reward_mean", "continue_mean", "actor_entropy")
    ]
    run.holds("losses and predictions have the digits of float32", share_in_bfloat16(values) < 0.5)
    run.holds(
        "the return range has the digits of float32",
        share_in_bfloat16([float(x) for x in state["return_range"].values()]) < 0.5,
    )


def refuses_shape(run: Run, function: str, arguments: tuple[Any, ...], name: str, shape: tuple[int, ...]) -> None:
    """Holds if the call raises a ValueError that names the argument and the shape that came."""
    try:
        run.call(function, *arguments)
    except ValueError as error:
        run.holds(f"{function}: {str(error)!r} names {name}", name in str(error))
        run.holds(
            f"{function}: {str(error)!r} names the shape {shape}", all(str(length) in str(error) for length in shape)
        )
        return
    run.holds(f"{function} refuses {name} of the shape {shape}", False)


def reshapings(array: np.ndarray) -> list[np.ndarray]:
    """Arrays that would broadcast against the right one, or nearly fit."""
    singles = [np.take(array, [0], axis) for axis in range(array.ndim) if array.shape[axis] > 1]
    return [array[..., None], array[0], *singles, np.concatenate([array, array[..., :1]], -1)]


@check("CON-1", "CON-8", "CON-20", uses=["losses"], level=2, dtypes=WHOLE)
def losses_refuse_other_shapes(run: Run) -> None:
    """Every array of the batch, the noise and the parameters must have its shape, and nothing broadcasts; messages name
    entry and shape."""
    problem = make_problem(run.seed, run.profile, "vector", "mixed", run.dtype)
    params, slow_critic, return_range, batch, noise, *rest = problem.loss_arguments
    for key, value in batch.items():
        for wrong in reshapings(value):
            arguments = (params, slow_critic, return_range, {**batch, key: wrong}, noise, *rest)
            # B and T, or the leading axes, may be read from the wrong array, and then it is another one that does not
            # fit.
            if key in ("prev_action", "deter", "stoch"):
                refuses_shape(run, "losses", arguments, key, wrong.shape)
            else:
                run.refuses("losses", *arguments)
    for key, value in noise.items():
        for wrong in reshapings(value):
            refuses_shape(
                run,
                "losses",
                (params, slow_critic, return_range, batch, {**noise, key: wrong}, *rest),
                key,
                wrong.shape,
            )
    for key in ("reward/out/bias", "rssm/hidden/scale", "rssm/gru/kernel", "actor/out/arm/mean/kernel"):
        for wrong in reshapings(params[key]):
            run.refuses("losses", {**params, key: wrong}, slow_critic, return_range, batch, noise, *rest)


@check("CON-1", "CON-5", "CON-8", "CON-20", uses=["policy_step"], level=1, dtypes=WHOLE)
def policy_step_refuses_other_shapes(run: Run) -> None:
    """Carry, previous action, observation, flags and noise must have their shapes, and nothing broadcasts."""
    arguments = policy_arguments(run, EXAMPLE, 4)
    for group in ("carry", "observation", "noise"):
        for key, value in arguments[group].items():
            for wrong in reshapings(value):
                run.refuses("policy_step", *{**arguments, group: {**arguments[group], key: wrong}}.values())
    for name in ("prev_action", "is_first"):
        for wrong in reshapings(arguments[name]):
            run.refuses("policy_step", *{**arguments, name: wrong}.values())
