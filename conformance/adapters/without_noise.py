"""What an implementation offers that takes no noise, made of the functions of one that does."""

from typing import TYPE_CHECKING, Any

import numpy as np

from reference_numpy.distributions import bounded_normal, unimix_log_probs
from reference_numpy.networks import feature
from spec import Config, Discrete, Spaces, parameter_table


class WithoutNoise:
    """For adapters: given samples are turned into noise that draws them, and drawn samples come from noise of NumPy's
    generator."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """The functions that take noise are those of the other base class."""

    def observe_given(
        self,
        params: Any,
        carry: Any,
        tokens: np.ndarray,
        prev_action: np.ndarray,
        is_first: np.ndarray,
        stoch: np.ndarray,
        config: Config,
    ) -> dict[str, np.ndarray]:
        deter, latent = carry["deter"], carry["stoch"]
        steps = []
        for t in range(is_first.shape[1]):
            keep = ~is_first[:, t, None]
            action = np.where(keep, prev_action[:, t], 0)
            deter = self.core(params, np.where(keep, deter, 0), np.where(keep[..., None], latent, 0), action, config)
            steps.append(
                (deter, self.posterior(params, deter, tokens[:, t], config), self.prior(params, deter, config))
            )
            latent = stoch[:, t]
        return {
            name: np.stack(values, 1)
            for name, values in zip(("deter", "posterior", "prior"), zip(*steps, strict=True), strict=True)
        }

    def imagine_given(
        self, params: Any, carry: Any, action: np.ndarray, stoch: np.ndarray, config: Config
    ) -> dict[str, np.ndarray]:
        deters, latent = [carry["deter"]], carry["stoch"]
        for t in range(action.shape[1]):
            deters.append(self.core(params, deters[-1], latent, action[:, t], config))
            latent = stoch[:, t]
        deter = np.stack(deters, 1)
        return {"deter": deter, "prior": self.prior(params, deter[:, 1:], config)}

    def losses_given(
        self, params: Any, slow_critic: Any, return_range: Any, batch: Any, samples: Any, spaces: Spaces, config: Config
    ) -> Any:
        noise = self.noise_of(params, batch, samples, spaces, config)
        return self.losses(params, slow_critic, return_range, batch, noise, spaces, config)

    def noise_of(self, params: Any, batch: Any, samples: Any, spaces: Spaces, config: Config) -> dict[str, np.ndarray]:
        """Noise that draws the given samples of a train step."""
        tokens = self.encoder(params, {key: batch[key] for key in spaces.observations}, spaces, config)
        carry = {"deter": batch["deter"], "stoch": np.eye(config.classes)[batch["stoch"]]}
        states = self.observe_given(
            params, carry, tokens, batch["prev_action"], batch["is_first"], samples["posterior"], config
        )
        starts = batch["is_first"].size
        start = {
            "deter": states["deter"].reshape(starts, -1),
            "stoch": samples["posterior"].reshape(starts, config.stoch, config.classes),
        }
        dream = self.imagine_given(params, start, samples["action"], samples["prior"], config)
        stoch = np.concatenate([start["stoch"][:, None], samples["prior"]], 1)
        outputs = self.actor(params, feature(dream["deter"], stoch)[:, :-1], spaces, config)
        return {
            "posterior": uniform_of(states["posterior"], config.latent_unimix, samples["posterior"]),
            "prior": uniform_of(dream["prior"], config.latent_unimix, samples["prior"]),
            "action": action_noise_of(outputs, samples["action"], spaces, config),
        }

    def draw_categorical(self, logits: np.ndarray, unimix: float, seed: int, n: int) -> np.ndarray:
        log_probs = self.unimix_log_probs(logits, unimix)
        uniform = np.random.default_rng(seed).random((n, len(logits)))
        return self.categorical_sample(np.broadcast_to(log_probs, (n, *logits.shape)), uniform)

    def draw_normal(self, mean: np.ndarray, std: np.ndarray, seed: int, n: int) -> np.ndarray:
        normal = np.random.default_rng(seed).normal(size=(n, *mean.shape))
        return self.normal_sample(np.broadcast_to(mean, normal.shape), np.broadcast_to(std, normal.shape), normal)

    def draw_actions(self, outputs: Any, spaces: Spaces, config: Config, seed: int, n: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        rows = {
            key: {name: np.broadcast_to(x, (n, *x.shape)) for name, x in values.items()}
            for key, values in outputs.items()
        }
        draws = [
            (rng.random if isinstance(space, Discrete) else rng.standard_normal)((n, *space.array_shape))
            for space in spaces.actions.values()
        ]
        return self.sample_action(rows, np.concatenate(draws, -1), spaces, config)

    def draw_parameters(self, spaces: Spaces, config: Config, seed: int) -> dict[str, np.ndarray]:
        table, rng = parameter_table(config, spaces), np.random.default_rng(seed)
        uniforms = {
            name: rng.random(entry.shape) for name, entry in table.items() if entry.initializer == "truncated_normal"
        }
        return self.initial_parameters(table, uniforms)


def uniform_of(logits: np.ndarray, unimix: float, onehot: np.ndarray) -> np.ndarray:
    """[...], uniform numbers in the middle of where the given classes [..., C] are drawn."""
    probs = np.exp(unimix_log_probs(logits, unimix))
    return np.sum(onehot * (np.cumsum(probs, -1) - probs / 2), -1)


def action_noise_of(outputs: Any, action: np.ndarray, spaces: Spaces, config: Config) -> np.ndarray:
    """[..., K], noise that draws the given flat actions [..., A]."""
    parts = []
    start = 0
    for key, space in spaces.actions.items():
        own = action[..., start : start + space.encoded_size]
        start += space.encoded_size
        if isinstance(space, Discrete):
            ends = np.cumsum(space.classes)[:-1]
            segments = zip(np.split(outputs[key]["logits"], ends, -1), np.split(own, ends, -1), strict=True)
            parts += [uniform_of(logits, config.actor_unimix, onehot)[..., None] for logits, onehot in segments]
        else:
            mean, std = bounded_normal(
                outputs[key]["mean"], outputs[key]["std"], config.actor_min_std, config.actor_max_std
            )
            parts.append((own - mean) / std)
    return np.concatenate(parts, -1)
