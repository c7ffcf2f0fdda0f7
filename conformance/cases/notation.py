"""Checks of spec/00-notation.md: conventions that every chapter shares. Most of them are also seen by the checks
of the other chapters."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from conformance.case import Cases, Equal, Setting, equal, judged, refused, related
from conformance.cases.agent import WHOLE, follows
from conformance.check import check
from conformance.compare import Comparisons, round_to
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
from conformance.worked import worked_cases
from reference_numpy import agent as reference_agent
from reference_numpy import behavior as reference_behavior
from reference_numpy import networks as reference_networks
from reference_numpy import optimizer as reference_optimizer
from spec import Discrete, Parameter, Spaces, Vector, parameter_table

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
    "reconstruction_scale": 0.9, "reward_scale": 1.3, "continue_scale": 0.7, "dynamics_scale": 0.6,
    "representation_scale": 0.35, "free_nats": 1.5, "vector_loss_scale": 0.77,
    "imagination_horizon": 4, "discount_horizon": 20.0, "return_lambda": 0.8, "actor_scale": 1.2,
    "critic_scale": 0.8, "replay_critic_scale": 0.45, "slow_critic_scale": 0.65, "entropy_scale": 0.05,
    "return_percentile_low": 20.0, "return_percentile_high": 70.0, "return_decay": 0.5, "return_limit": 1e4,
}  # fmt: skip
OPTIMIZER_NUMBERS = {
    "learning_rate": 0.003, "warmup_steps": 25, "agc_clip": 0.02, "agc_epsilon": 0.5, "beta1": 0.8, "beta2": 0.95,
    "laprop_epsilon": 0.1, "slow_critic_decay": 0.9,
}  # fmt: skip


def policy_arguments(setting: Setting, task: Spaces, rows: int) -> dict[str, Any]:
    """Keyword arguments of `policy_step`, in its order."""
    rng, config = setting.rng(), small_config(setting.profile, setting.dtype)
    return {
        "params": random_parameters(rng, config, task, setting.dtype),
        "carry": random_carry(rng, config, (rows,)),
        "prev_action": np.zeros((rows, task.action_size)),
        "observation": random_observations(rng, task, (rows,)),
        "is_first": np.arange(rows) % 4 == 0,
        "noise": {"posterior": uniforms(rng, rows, config.stoch), "action": action_noise(rng, task, (rows,))},
        "spaces": task,
        "config": config,
    }


@check("CON-18", "CON-19", "CON-26", "CON-27", "BEH-8", uses=["sample_action"], level=0)
def the_flat_action_of_the_chapter(setting: Setting) -> Cases:
    """Buttons (1, 0) and turn (0.5, -2.0) are the flat action (0, 1, 1, 0, 0, 0.5, -2.0), sampled from two uniforms,
    then two normals."""
    yield from worked_cases(setting, "notation", "a flat action", floor=1.0, bound=16 * setting.u)
    yield from worked_cases(setting, "behavior", "an action of several keys", floor=1.0, bound=16 * setting.u)


@check("CON-25", "CON-26", "NET-3", "BEH-8", uses=["sample_action", "encoder"], level=1)
def keys_are_walked_in_sorted_order(setting: Setting) -> Cases:
    """Signs before digits, capitals, "_" and small letters, in whatever order the mappings hold them."""
    rng, config = setting.rng(), small_config(setting.profile, setting.dtype)
    outputs: dict[str, dict[str, np.ndarray]] = {}
    for key in reversed(list(ODD_KEYS.actions)):
        space = ODD_KEYS.actions[key]
        names = ("logits",) if isinstance(space, Discrete) else ("mean", "std")
        outputs[key] = {name: setting.cast(rng.normal(size=(6, space.encoded_size))) for name in names}
    noise = action_noise(rng, ODD_KEYS, (6,))
    expected = reference_behavior.sample_action(outputs, noise, ODD_KEYS, config)
    yield equal("sample_action", (outputs, noise, ODD_KEYS, config), expected, magnitude=5.0)
    params = random_parameters(rng, config, ODD_KEYS, setting.dtype)
    observation = random_observations(rng, ODD_KEYS, (3,))
    backwards = {key: observation[key] for key in reversed(observation)}
    expected = reference_networks.encoder(params, observation, ODD_KEYS, config)
    yield equal("encoder", (params, backwards, ODD_KEYS, config), expected, magnitude="tensor", factor=8)


@check("CON-16", uses=["policy_step"], level=1)
def samples_come_from_the_noise_alone(setting: Setting) -> Cases:
    """The same noise gives the same latents and actions again; other noise gives others."""
    arguments = policy_arguments(setting, EXAMPLE, 32)
    rng, noise = np.random.default_rng(setting.seed + 1), arguments["noise"]
    others = {
        "posterior": uniforms(rng, *noise["posterior"].shape),
        "action": action_noise(rng, EXAMPLE, (32,)),
    }
    posterior, action = ({**arguments, "noise": {**noise, name: other}} for name, other in others.items())

    def depend_on_it(c: Comparisons, first: Any, again: Any, posterior: Any, action: Any) -> None:
        c.exact("action", again[1], first[1])
        c.exact("stoch", again[0]["stoch"], first[0]["stoch"])
        changed = np.any(posterior[0]["stoch"] != first[0]["stoch"], (1, 2))
        c.holds("other noise gives other latents", np.mean(changed) > 0.5)
        c.exact("latents do not depend on the noise of the action", action[0]["stoch"], first[0]["stoch"])
        before, after = np.asarray(first[1]), np.asarray(action[1])
        c.holds("other noise gives other numbers", after[:, 5:] != before[:, 5:])
        c.holds("other noise gives other choices", np.any(after[:, :5] != before[:, :5]))

    inputs = (arguments, arguments, posterior, action)
    yield related(depend_on_it, *(("policy_step", tuple(entries.values())) for entries in inputs))


@check("CON-28", "NET-27", uses=["encoder"], level=1)
def scalars_have_an_axis(setting: Setting) -> Cases:
    """A scalar observation is a Vector of size 1 or a Discrete with one entry; without its axis it is refused."""
    task = Spaces({"speed": Vector(1), "gear": Discrete((3,))}, {"a": Vector(1)})
    config = small_config(setting.profile, setting.dtype)
    params = random_parameters(setting.rng(), config, task, setting.dtype)
    observation = random_observations(setting.rng(), task, (4,))
    expected = reference_networks.encoder(params, observation, task, config)
    yield equal("encoder", (params, observation, task, config), expected, magnitude="tensor", factor=8)
    for key in task.observations:
        yield refused("encoder", params, {**observation, key: observation[key][:, 0]}, task, config)


@check("CON-31", uses=["reward_head", "critic"], level=1)
def parameters_have_full_names(setting: Setting) -> Cases:
    """A part finds its parameters by full name, in the mapping of all of them as in one that holds nothing else."""
    task, config = EXAMPLE, small_config(setting.profile, setting.dtype)
    params = random_parameters(setting.rng(), config, task, setting.dtype)
    feature = setting.cast(setting.rng().normal(size=(4, config.feature_size)))
    for function, prefix in (("reward_head", "reward/"), ("critic", "critic/")):
        alone = {name: value for name, value in params.items() if name.startswith(prefix)}
        moved = {name: value if name.startswith(prefix) else value + 1 for name, value in params.items()}

        def same(c: Comparisons, everything: Any, alone: Any, moved: Any, function: str = function) -> None:
            c.exact(function, alone, everything)
            c.exact(f"{function} with other parameters elsewhere", moved, everything)

        yield related(same, *((function, (given, feature, config)) for given in (params, alone, moved)))


def fits(table: Mapping[str, Parameter]) -> Callable[[Comparisons, Any], None]:
    """The relation that a mapping has the names and shapes of the table."""

    def relation(c: Comparisons, arrays: Any) -> None:
        c.holds("the names of the table", set(arrays) == set(table))
        c.holds("the shapes of the table", [np.shape(arrays[name]) == entry.shape for name, entry in table.items()])

    return relation


@check("CON-29", "CON-30", uses=["gradients"], level=2, dtypes=WHOLE)
def gradients_have_the_names_and_shapes_of_the_table(setting: Setting) -> Cases:
    """One array for each canonical name, in the canonical layout."""
    problem = make_problem(setting.seed, setting.profile, "both", "mixed", setting.dtype)
    yield judged("gradients", problem.loss_arguments, fits(parameter_table(problem.config, problem.spaces)))


@check("CON-29", "CON-30", uses=["initial_parameters"], level=1, dtypes=WHOLE)
def parameters_have_the_names_and_shapes_of_the_table(setting: Setting) -> Cases:
    """A flat mapping from canonical names to arrays in the canonical layouts; convolution kernels are [5, 5, in,
    out]."""
    problem = make_problem(setting.seed, setting.profile, "both", "mixed", setting.dtype)
    table = parameter_table(problem.config, problem.spaces)
    drawn = {
        name: np.full(entry.shape, 0.25) for name, entry in table.items() if entry.initializer == "truncated_normal"
    }
    yield judged("initial_parameters", (table, drawn), fits(table))


def odd_problem(setting: Setting, observation: str, action: str) -> Problem:
    """Numbers of its own throughout, and each choice other than in the profile."""
    plain = small_config(setting.profile, setting.dtype)
    choices = {
        "continue_target": "discounted" if plain.continue_target == "hard" else "hard",
        "start_continue": "predicted" if plain.start_continue == "true" else "true",
        "cnn_sampling": "pooled" if plain.cnn_sampling == "strided" else "strided",
        "cnn_outer": not plain.cnn_outer,
        "cnn_multipliers": (3, 4) if plain.cnn_outer else (2, 3, 4),
    }
    sizes = {"units": 12, "deter": 24, "stoch": 4, "classes": 3, "cnn_depth": 1, "batch_size": 3, "batch_length": 4}
    numbers = {**LOSS_NUMBERS, **OPTIMIZER_NUMBERS, **choices, **sizes}
    return make_problem(setting.seed, setting.profile, observation, action, setting.dtype, **numbers)


@check("CON-32", uses=["losses"], level=2, dtypes=("float64",))
def losses_take_every_number_from_the_configuration(setting: Setting) -> Cases:
    """Losses agree where no number and no choice is that of a profile."""
    problem = odd_problem(setting, "both", "mixed")
    total, aux = reference_agent.losses(*problem.loss_arguments)
    size, range_ = max(1.0, *map(abs, aux["losses"].values())), np.array(aux["return_range"])
    yield judged(
        "losses",
        problem.loss_arguments,
        Equal(aux["losses"], (1, "losses"), where="losses", magnitude=size, bound=1e-9),
        Equal(range_, (1, "return_range"), where="return_range", magnitude=1.0, bound=1e-9),
        Equal(total, (0,), where="total", bound=1e-9),
    )


@check("CON-32", uses=["optimizer_step"], level=3)
def the_optimizer_takes_every_number_from_the_configuration(setting: Setting) -> Cases:
    """Updates agree where no number is that of a profile."""
    precision = "float64" if setting.dtype == "float64" else "float32"
    config = small_config(setting.profile, precision, **OPTIMIZER_NUMBERS)
    state = random_state(setting.rng(), config, EXAMPLE, setting.dtype)
    gradients = {name: round_to(value[::-1] * 10, "float32") for name, value in state["params"].items()}
    arguments = (state["params"], gradients, state["optimizer"], config)
    params, moments = reference_optimizer.optimizer_step(*arguments)
    bound = 1e-12 if setting.dtype == "float64" else 2e-5
    yield judged(
        "optimizer_step",
        arguments,
        Equal(params, (0,), where="params", magnitude=1.0, bound=bound),
        *(
            Equal(moments[moment], (1, moment), where=moment, magnitude="tensor", bound=bound)
            for moment in ("second_moment", "momentum")
        ),
    )


def step_agrees(expected: Any) -> Iterator[Equal]:
    """Demands of a train step."""
    state, _ = expected
    for group in ("params", "slow_critic"):
        yield Equal(state[group], (0, group), where=group, magnitude=1.0, bound=1e-9)
    momentum = state["optimizer"]["momentum"]
    yield Equal(momentum, (0, "optimizer", "momentum"), where="momentum", magnitude=1.0, bound=1e-8)


@check("CON-32", uses=["train_step", "gradients"], level=3, dtypes=("float64",))
def a_step_takes_every_number_from_the_configuration(setting: Setting) -> Cases:
    """Parameters, momentum and slow critic agree after a step where no number is that of a profile."""
    problem = odd_problem(setting, "vector", "mixed")
    inputs = (problem.state, problem.batch, problem.noise, problem.spaces, problem.config)
    yield related(follows(problem, step_agrees), ("gradients", problem.loss_arguments), ("train_step", inputs))


@check("CON-32", uses=["train_step_with"], level=3, dtypes=("float64",))
def a_step_with_given_gradients_takes_every_number_from_the_configuration(setting: Setting) -> Cases:
    """The same with given gradients."""
    problem = odd_problem(setting, "vector", "mixed")
    gradients = {name: value[::-1] * 10 for name, value in problem.state["params"].items()}
    arguments = (problem.state, problem.batch, problem.noise, gradients, problem.spaces, problem.config)
    yield judged("train_step_with", arguments, *step_agrees(reference_agent.train_step(*arguments)))


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
def what_must_be_float32_is_float32(setting: Setting) -> Cases:
    """With activations in bfloat16: losses, return range, gradients and everything that a step keeps have more digits
    than bfloat16."""
    for observation, action in (("vector", "continuous"), ("both", "mixed")):
        problem = make_problem(setting.seed, setting.profile, observation, action, "bfloat16")
        inputs = (problem.state, problem.batch, problem.noise, problem.spaces, problem.config)
        yield judged("train_step", inputs, a_step_has_digits)
        yield judged("gradients", problem.loss_arguments, gradients_have_digits)


def a_step_has_digits(c: Comparisons, result: Any) -> None:
    state, aux = result
    moments = {name: state["optimizer"][name] for name in ("momentum", "second_moment")}
    for where, group in {"params": state["params"], "slow_critic": state["slow_critic"], **moments}.items():
        numbers = np.concatenate([np.ravel(x) for x in group.values()])
        c.holds(f"{where} have the digits of float32", share_in_bfloat16(numbers) < 0.1)
    metrics = ("return_mean", "value_mean", "reward_mean", "continue_mean", "actor_entropy")
    values = [aux["losses"][name] for name in ("reward", "continue", "actor", "critic", "replay_critic")]
    values += [aux["metrics"][name] for name in metrics]
    c.holds("losses and predictions have the digits of float32", share_in_bfloat16(values) < 0.5)
    range_ = [float(x) for x in state["return_range"].values()]
    c.holds("the return range has the digits of float32", share_in_bfloat16(range_) < 0.5)


def gradients_have_digits(c: Comparisons, gradients: Any) -> None:
    for name, gradient in gradients.items():
        if is_long_sum(name, gradient):
            c.holds(f"the gradient of {name} has the digits of float32", share_in_bfloat16(gradient) < 0.75)


def reshapings(array: np.ndarray) -> list[np.ndarray]:
    """Arrays that would broadcast against the right one, or nearly fit."""
    singles = [np.take(array, [0], axis) for axis in range(array.ndim) if array.shape[axis] > 1]
    return [array[..., None], array[0], *singles, np.concatenate([array, array[..., :1]], -1)]


@check("CON-1", "CON-8", "CON-20", uses=["losses"], level=2, dtypes=WHOLE)
def losses_refuse_other_shapes(setting: Setting) -> Cases:
    """Every array of the batch, the noise and the parameters must have its shape, and nothing broadcasts; messages name
    entry and shape."""
    problem = make_problem(setting.seed, setting.profile, "vector", "mixed", setting.dtype)
    params, slow_critic, return_range, batch, noise, *rest = problem.loss_arguments

    def named(key: str, wrong: np.ndarray) -> tuple[str, ...]:
        return (key, *map(str, wrong.shape))

    for key, value in batch.items():
        for wrong in reshapings(value):
            # B and T, or the leading axes, may be read from the wrong array, and then it is another one that does not
            # fit.
            naming = named(key, wrong) if key in ("prev_action", "deter", "stoch") else ()
            arguments = (params, slow_critic, return_range, {**batch, key: wrong}, noise, *rest)
            yield refused("losses", *arguments, naming=naming)
    for key, value in noise.items():
        for wrong in reshapings(value):
            arguments = (params, slow_critic, return_range, batch, {**noise, key: wrong}, *rest)
            yield refused("losses", *arguments, naming=named(key, wrong))
    for key in ("reward/out/bias", "rssm/hidden/scale", "rssm/gru/kernel", "actor/out/arm/mean/kernel"):
        for wrong in reshapings(params[key]):
            yield refused("losses", {**params, key: wrong}, slow_critic, return_range, batch, noise, *rest)


@check("CON-1", "CON-5", "CON-8", "CON-20", uses=["policy_step"], level=1, dtypes=WHOLE)
def policy_step_refuses_other_shapes(setting: Setting) -> Cases:
    """Carry, previous action, observation, flags and noise must have their shapes, and nothing broadcasts."""
    arguments = policy_arguments(setting, EXAMPLE, 4)
    for group in ("carry", "observation", "noise"):
        for key, value in arguments[group].items():
            for wrong in reshapings(value):
                yield refused("policy_step", *{**arguments, group: {**arguments[group], key: wrong}}.values())
    for name in ("prev_action", "is_first"):
        for wrong in reshapings(arguments[name]):
            yield refused("policy_step", *{**arguments, name: wrong}.values())
