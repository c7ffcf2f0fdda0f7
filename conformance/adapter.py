"""The adapter: how the kit reaches an implementation.

An adapter is any object or module with some of the functions below, NumPy in and NumPy out. Every function is optional:
what is missing is reported as not offered. Shapes and meanings are those of the reference function of the same name,
which its chapter defines. Parameters are the flat mapping of canonical names (spec/parameters.py), a state is
the training state of [AGT], noise is an argument. Functions named `..._given` are the same without noise: they take the
samples instead. Functions named `draw_...` sample with a generator of their own, made from a seed. How to write an
adapter is in docs/adapters.md.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from conformance.running.interface import RunEnvironment, RunLearner, RunOptions
from spec import Config, Parameter, Spaces

Array = np.ndarray
Arrays = Mapping[str, np.ndarray]
Nested = Mapping[str, Any]
Range = tuple[float, float]


class Adapter(Protocol):
    """Every function that the checks know."""

    # transforms
    def symlog(self, x: Array) -> Array: ...
    def symexp(self, x: Array) -> Array: ...
    def exponential_bins(self, bins: int) -> Array: ...
    def twohot(self, x: Array, bins: Array) -> Array: ...
    def ordered_expectation(self, probs: Array, bins: Array) -> Array: ...

    # distributions
    def unimix_log_probs(self, logits: Array, unimix: float) -> Array: ...
    def categorical_sample(self, log_probs: Array, uniform: Array) -> Array: ...
    def straight_through(self, log_probs: Array, sample: Array) -> Array: ...
    def categorical_log_prob(self, log_probs: Array, onehot: Array) -> Array: ...
    def categorical_entropy(self, log_probs: Array) -> Array: ...
    def categorical_kl(self, log_probs_p: Array, log_probs_q: Array) -> Array: ...
    def symexp_twohot_loss(self, logits: Array, target: Array, bins: Array) -> Array:
        """Cross-entropy towards the two-hot encoding of a number.

        Args:
          logits: [..., K]; K varies.
          target: [...], raw, not passed through symlog.
          bins: [K], the raw positions, which symexp has spaced. Code of the edition 2023 takes symlog of them.

        Returns:
          [...], in nats.
        """

    def symexp_twohot_mean(self, logits: Array, bins: Array) -> Array:
        """The number that a symexp-twohot output predicts.

        Args:
          logits: [..., K]; K varies.
          bins: [K], the raw positions, which symexp has spaced. Code of the edition 2023 takes symlog of them.

        Returns:
          [...], raw, not in symlog space; exactly 0 for equal logits.
        """

    def bernoulli_loss(self, logit: Array, target: Array) -> Array: ...
    def bernoulli_mean(self, logit: Array) -> Array: ...
    def bounded_normal(self, mean: Array, std: Array, min_std: float, max_std: float) -> tuple[Array, Array]: ...
    def normal_sample(self, mean: Array, std: Array, normal: Array) -> Array: ...
    def normal_log_prob(self, mean: Array, std: Array, value: Array) -> Array: ...
    def normal_entropy(self, std: Array) -> Array: ...
    def mse_loss(self, prediction: Array, target: Array) -> Array: ...
    def symlog_mse_loss(self, prediction: Array, target: Array, scale: float) -> Array: ...
    def draw_categorical(self, logits: Array, unimix: float, seed: int, n: int) -> Array:
        """Independent samples of a categorical mixed with the uniform distribution.

        Args:
          logits: [S, C], before the mixture.
          unimix: share of the uniform distribution, 0 to 1.
          seed, n: of the generator, and how many samples.

        Returns:
          [n, S, C], one-hots; or [n, S], whole numbers below C.
        """

    def draw_normal(self, mean: Array, std: Array, seed: int, n: int) -> Array:
        """Independent samples of a normal.

        Args:
          mean, std: [D].
          seed, n: of the generator, and how many samples.

        Returns:
          [n, D].
        """

    # layers
    def linear(self, x: Array, kernel: Array, bias: Array) -> Array: ...
    def block_linear(self, x: Array, kernel: Array, bias: Array) -> Array: ...
    def rms_norm(self, x: Array, scale: Array, epsilon: float) -> Array: ...
    def silu(self, x: Array) -> Array: ...
    def convolution(self, x: Array, kernel: Array, bias: Array, stride: int) -> Array: ...
    def transposed_convolution(self, x: Array, kernel: Array, bias: Array) -> Array: ...
    def max_pool(self, x: Array) -> Array: ...
    def upsample(self, x: Array) -> Array: ...
    def dense(self, params: Arrays, name: str, x: Array, epsilon: float) -> Array: ...
    def mlp(self, params: Arrays, name: str, x: Array, layers: int, epsilon: float) -> Array: ...
    def truncated_normal(self, uniform: Array, fan_in: int, outscale: float) -> Array: ...

    # rssm
    def core(self, params: Arrays, deter: Array, stoch: Array, action: Array, config: Config) -> Array: ...
    def prior(self, params: Arrays, deter: Array, config: Config) -> Array: ...
    def posterior(self, params: Arrays, deter: Array, tokens: Array, config: Config) -> Array: ...
    def observe(
        self,
        params: Arrays,
        carry: Arrays,
        tokens: Array,
        prev_action: Array,
        is_first: Array,
        uniform: Array,
        config: Config,
    ) -> Arrays: ...
    def imagine(self, params: Arrays, carry: Arrays, action: Array, uniform: Array, config: Config) -> Arrays:
        """Imagination under given actions.

        Args:
          params: `rssm/...`.
          carry: "deter" [N, D] and "stoch" [N, S, C], the states to start from.
          action: [N, H, A], in place of a policy.
          uniform: [N, H, S], numbers in [0, 1); entry t draws the latents of state t + 1.

        Returns:
          "deter" [N, H+1, D], "stoch" [N, H+1, S, C] and "action" [N, H, A].
        """

    def observe_given(
        self,
        params: Arrays,
        carry: Arrays,
        tokens: Array,
        prev_action: Array,
        is_first: Array,
        stoch: Array,
        config: Config,
    ) -> Arrays:
        """A sequence of observations with given latents: what `observe` computes, up to the logits.

        Args:
          params: `rssm/...`.
          carry: "deter" [B, D] and "stoch" [B, S, C] of the step before the first one.
          tokens, prev_action, is_first: [B, T, E], [B, T, A] and [B, T], as `observe` takes them.
          stoch: [B, T, S, C], one-hot; entry t is the latent of step t, which step t + 1 goes on from.

        Returns:
          "deter" [B, T, D], "posterior" and "prior" [B, T, S, C], the logits of both from the memory of that step.
        """

    def imagine_given(self, params: Arrays, carry: Arrays, action: Array, stoch: Array, config: Config) -> Arrays:
        """Imagination under given actions and with given latents.

        Args:
          params: `rssm/...`.
          carry: "deter" [N, D] and "stoch" [N, S, C], the states to start from.
          action: [N, H, A].
          stoch: [N, H, S, C], one-hot; entry t is the latent of state t + 1.

        Returns:
          "deter" [N, H+1, D], and "prior" [N, H, S, C], where entry t is the logits of state t + 1.
        """

    # networks
    def encoder(self, params: Arrays, observations: Arrays, spaces: Spaces, config: Config) -> Array: ...
    def decoder(self, params: Arrays, feature: Array, spaces: Spaces, config: Config) -> Arrays: ...
    def reward_head(self, params: Arrays, feature: Array, config: Config) -> Array: ...
    def continue_head(self, params: Arrays, feature: Array, config: Config) -> Array: ...
    def actor(self, params: Arrays, feature: Array, spaces: Spaces, config: Config) -> Nested: ...
    def critic(self, params: Arrays, feature: Array, config: Config) -> Array: ...

    # world_model
    def continue_target(self, is_terminal: Array, config: Config) -> Array: ...
    def kl_losses(self, posterior_logits: Array, prior_logits: Array, config: Config) -> tuple[Array, Array]: ...
    def reconstruction_losses(
        self, predictions: Arrays, observations: Arrays, spaces: Spaces, config: Config
    ) -> Arrays: ...
    def open_loop(
        self,
        params: Arrays,
        observation: Arrays,
        prev_action: Array,
        is_first: Array,
        context: int,
        noise: Arrays,
        spaces: Spaces,
        config: Config,
    ) -> Arrays: ...

    # returns
    def lambda_return(
        self, reward: Array, continue_: Array, value: Array, discount: float, lambda_: float
    ) -> Array: ...
    def replay_lambda_return(
        self, reward: Array, is_last: Array, is_terminal: Array, annotation: Array, discount: float, lambda_: float
    ) -> Array: ...
    def cumulative_weights(self, continue_: Array, discount: float) -> Array: ...
    def percentile(self, values: Array, q: float) -> Array: ...
    def update_return_range(self, low: Array, high: Array, returns: Array, config: Config) -> tuple[Array, Array]: ...
    def return_scale(self, low: Array, high: Array, limit: float) -> Array: ...

    # behavior
    def sample_action(self, outputs: Nested, noise: Array, spaces: Spaces, config: Config) -> Array: ...
    def action_log_prob(self, outputs: Nested, action: Array, spaces: Spaces, config: Config) -> Array: ...
    def action_entropy(self, outputs: Nested, spaces: Spaces, config: Config) -> Array: ...
    def actor_loss(
        self, log_prob: Array, entropy: Array, returns: Array, value: Array, weight: Array, scale: Array, config: Config
    ) -> Array: ...
    def critic_loss(
        self, logits: Array, slow_logits: Array, returns: Array, weight: Array, config: Config
    ) -> Array: ...
    def replay_critic_loss(
        self, logits: Array, slow_logits: Array, returns: Array, is_last: Array, config: Config
    ) -> Array: ...
    def update_slow_critic(self, slow: Arrays, critic: Arrays, decay: float) -> Arrays: ...
    def draw_actions(self, outputs: Nested, spaces: Spaces, config: Config, seed: int, n: int) -> Array:
        """Independent samples of the policy at one state.

        Args:
          outputs: action key -> {"logits": [sum of classes]} or {"mean", "std": [size]}, the actor's raw outputs.
          seed, n: of the generator, and how many samples.

        Returns:
          [n, A], flat actions.
        """

    # optimizer
    def adaptive_gradient_clip(self, gradient: Array, parameter: Array, clip: float, epsilon: float) -> Array: ...
    def learning_rate(self, step: int, config: Config) -> float: ...
    def laprop(
        self, gradient: Array, second_moment: Array, momentum: Array, step: int, config: Config
    ) -> tuple[Array, Array, Array]: ...
    def optimizer_step(
        self, params: Arrays, gradients: Arrays, state: Nested, config: Config
    ) -> tuple[Arrays, Nested]: ...

    # agent
    def initial_parameters(self, table: Mapping[str, Parameter], uniforms: Arrays) -> Arrays: ...
    def draw_parameters(self, spaces: Spaces, config: Config, seed: int) -> Arrays:
        """Fresh parameters by the implementation's own initializer and generator.

        Returns:
          Canonical name -> array, for exactly the names of `spec.parameter_table(config, spaces)`.
        """

    def initial_state(self, params: Arrays) -> Nested: ...
    def policy_step(
        self,
        params: Arrays,
        carry: Arrays,
        prev_action: Array,
        observation: Arrays,
        is_first: Array,
        noise: Arrays,
        spaces: Spaces,
        config: Config,
    ) -> tuple[Arrays, Array]: ...
    def losses(
        self,
        params: Arrays,
        slow_critic: Arrays,
        return_range: Range,
        batch: Arrays,
        noise: Arrays,
        spaces: Spaces,
        config: Config,
    ) -> tuple[float, Nested]: ...
    def loss_derivatives(
        self,
        params: Arrays,
        slow_critic: Arrays,
        return_range: Range,
        batch: Arrays,
        noise: Arrays,
        spaces: Spaces,
        config: Config,
        directions: Sequence[Arrays],
    ) -> Arrays:
        """Loss name -> [directions]: the derivative of each unweighted mean loss along each direction in parameter
        space.

        A direction names the parameters that move; with automatic differentiation this is the inner product with the
        loss's gradient.
        """

    def gradients(
        self,
        params: Arrays,
        slow_critic: Arrays,
        return_range: Range,
        batch: Arrays,
        noise: Arrays,
        spaces: Spaces,
        config: Config,
    ) -> Arrays:
        """d total / d params of `losses`, by name."""

    def train_step(
        self, state: Nested, batch: Arrays, noise: Arrays, spaces: Spaces, config: Config
    ) -> tuple[Nested, Nested]:
        """One whole training step with the candidate's own gradients: (new state, aux of `losses`)."""

    def train_step_with(
        self, state: Nested, batch: Arrays, noise: Arrays, gradients: Arrays, spaces: Spaces, config: Config
    ) -> tuple[Nested, Nested]:
        """The same with given gradients, for implementations without automatic differentiation."""

    def losses_given(
        self,
        params: Arrays,
        slow_critic: Arrays,
        return_range: Range,
        batch: Arrays,
        samples: Arrays,
        spaces: Spaces,
        config: Config,
    ) -> tuple[float, Nested]:
        """`losses` with given samples in place of the noise.

        Args:
          params, slow_critic, return_range, batch: as `losses` takes them.
          samples: "posterior" [B, T, S, C] and "prior" [N, H, S, C], one-hot, and "action" [N, H, A], flat, with N =
            B*T. Gradients are those of samples: straight through "posterior", none into the others.

        Returns:
          The total and the aux of `losses`.
        """

    def gradients_given(
        self,
        params: Arrays,
        slow_critic: Arrays,
        return_range: Range,
        batch: Arrays,
        samples: Arrays,
        spaces: Spaces,
        config: Config,
    ) -> Arrays:
        """d total / d params of `losses_given`, by name."""

    def train_step_given(
        self, state: Nested, batch: Arrays, samples: Arrays, spaces: Spaces, config: Config
    ) -> tuple[Nested, Nested]:
        """`train_step` with given samples in place of the noise: see `losses_given`."""

    def vjp(self, function: str, arguments: tuple[Any, ...], cotangents: Any) -> Sequence[Any]:
        """What flows back into the arguments of a function of this interface. Where `convert` makes tensors of PyTorch
        or JAX, the kit finds it by itself.

        Args:
          function: its name.
          arguments: as it takes them.
          cotangents: an array of the shape of its result; name -> array where it has several.

        Returns:
          The arguments, with the gradient of the sum of results times cotangents in place of each array of real
          numbers, and 0 in place of all else.
        """

    # The object that is trained, with its own noise and caches.
    def Learner(self, spaces: Spaces, config: Config, seed: int) -> "Learner":  # noqa: N802
        """An agent and its optimizer in training: what runs for days.

        Args:
          spaces, config: of the task and of the agent.
          seed: of the initial parameters.

        Returns:
          An object with the methods state_dict(), load_state_dict(state), train_step(batch, seed),
          initial_carry(envs), policy(observation, is_first, carry, seed), train_noise(batch, seed) and
          policy_noise(envs, seed). `conformance.adapter.Learner` says what they take and give.
        """

    # replay and training loop: shared by all backends. The classes have the constructors and methods of the
    # reference's.
    def Replay(self, capacity: int, length: int) -> Any: ...  # noqa: N802
    def ReplayRatio(self, replay_ratio: float, batch_steps: int) -> Any: ...  # noqa: N802
    def can_train(self, items: int, config: Config) -> bool: ...
    def step_flags(self, reset: bool, terminated: bool, truncated: bool) -> Mapping[str, bool]: ...
    def make_record(
        self, observation: Arrays, reward: float, flags: Mapping[str, bool], action: Array, deter: Array, stoch: Array
    ) -> Arrays: ...
    def environment_action(self, action: Array, spaces: Spaces, low: Arrays, high: Arrays) -> Arrays: ...
    def derive_seed(self, seed: int, purpose: str, index: int) -> int: ...
    def run(
        self,
        environment: Callable[[], RunEnvironment],
        learner: Callable[[Spaces, Config, int], RunLearner],
        options: RunOptions,
    ) -> Nested | None:
        """A whole training run, in this process and with the environments and the learner that are given.

        Args:
          environment: makes one, with reset(seed=...) and step(action) as Gymnasium has them. Its bounds of actions are
            its attributes low and high: key -> [size].
          learner: called with spaces, config and seed, makes the learner that acts and is trained: initial_carry(envs),
            policy(observation, is_first, carry, seed), train_step(batch, seed), state_dict(), load_state_dict(state),
            save_carry(carry), load_carry(arrays).
          options: what the run shall be: spaces, config, seed, steps, directory, action_repeat, evaluate_every,
            evaluation_episodes, shared_environment, nonfinite, begin_with. Raise NotImplementedError for what the loop
            does not have. `conformance.running.interface` says what each of these three means.

        Returns:
          None, or "episodes": score and length of each episode of training, in the order of their ends; "evaluations":
          the mean score of each evaluation. A continued run says those since it was continued.
        """


class Learner(Protocol):
    """An agent and its optimizer in training. A seed says which random numbers a step draws.

    Two things are judged where they are there: a `policy(..., mode=True)` that acts by the mode [LOOP-71], and
    `predict(observation, prev_action, is_first, context, seed)`, an open-loop prediction by names of observations.
    """

    def state_dict(self) -> Arrays:
        """The training state under its canonical names [AGT-9]."""

    def load_state_dict(self, state: Arrays) -> None:
        """Takes over a training state."""

    def train_step(self, batch: Arrays, seed: int) -> tuple[Arrays, Arrays]:
        """One update. Returns metrics, of them "loss/NAME" of every loss, and the latents {"deter" [B, T, D], "stoch"
        [B, T, S] class indices}."""

    def initial_carry(self, envs: int) -> Any:
        """The carry of environments before their first step; opaque."""

    def policy(self, observation: Arrays, is_first: Array, carry: Any, seed: int) -> tuple[Array, Arrays, Any]:
        """One acting step of N environments: action [N, A], latents {"deter" [N, D], "stoch" [N, S]}, carry."""

    def train_noise(self, batch: Arrays, seed: int) -> Arrays:
        """The noise that `train_step` draws with this seed [CON-20]."""

    def policy_noise(self, envs: int, seed: int) -> Arrays:
        """The noise that `policy` draws with this seed: "posterior" [N, S] and "action" [N, K] [CON-19]."""


class Hooks(Protocol):
    """What else an adapter may hold. No check asks for these."""

    def setup(self, dtype: str) -> None:
        """Called once before all checks, with the precision to compute in: "float64", "float32" or "bfloat16"."""

    def edition(self) -> str | None:
        """The edition that the implementation claims to be: "2023", "2024-04", "2024-12" or "paper"; None for no
        claim."""

    def convert(self, array: Array) -> Any:
        """Called on every array before it is handed to a function: `convert = torch.as_tensor`."""
