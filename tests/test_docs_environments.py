"""The wrapper in docs/environments.md: what it does with moves that are not possible."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from dreamer_spec.envs import ContractEnv
from dreamer_spec.envs.adapter import array_spaces
from spec import Discrete


class LegalMoves(gymnasium.Wrapper):
    """A move that is not possible changes nothing and costs a little; which ones are possible is seen."""

    def __init__(self, env: gymnasium.Env, penalty: float = 0.02) -> None:
        super().__init__(env)
        self._penalty = penalty
        self.observation_space = spaces.Dict(
            {"board": env.observation_space, "legal": spaces.MultiBinary(int(env.action_space.n))}
        )

    def reset(self, **given):
        board, info = self.env.reset(**given)
        return self._see(board, info), info

    def step(self, move):
        if not self._seen["legal"][move]:
            return self._seen, -self._penalty, False, False, self._info
        board, reward, terminated, truncated, info = self.env.step(move)
        return self._see(board, info), reward, terminated, truncated, info

    def _see(self, board, info):
        self._info, self._seen = info, {"board": board, "legal": np.array(info["action_mask"], np.int8)}
        return self._seen


def make_env() -> gymnasium.Env[Any, Any]:
    newest = max(id for id in gymnasium.registry if id.startswith("Taxi-v"))
    return LegalMoves(gymnasium.make(newest))


def test_an_impossible_move_changes_nothing_and_costs_a_little() -> None:
    env = make_env()
    seen = dict(env.reset(seed=0)[0])
    impossible, possible = (int(np.flatnonzero(seen["legal"] == legal)[0]) for legal in (0, 1))
    again, reward, terminated, truncated, _ = env.step(impossible)
    assert again["board"] == seen["board"]
    assert again["legal"].tolist() == seen["legal"].tolist()
    assert (reward, terminated, truncated) == (-0.02, False, False)
    later, reward, *_ = env.step(possible)
    assert reward == -1, "the environment's own"
    assert later["board"] != again["board"]


def test_the_agent_sees_what_is_possible() -> None:
    env = ContractEnv(make_env(), "t")
    assert env.spaces.observations == {"board": Discrete((500,)), "legal": Discrete((2,) * 6)}
    observation, _ = env.reset(seed=0)
    assert array_spaces(env.spaces)[0].contains(observation)
