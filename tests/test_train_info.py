"""Numbers of an environment's info: chosen by name, checked, and logged with the episode and the evaluation."""

from typing import Any

import numpy as np
import pytest
import train_fakes
from train_fakes import EPISODE, FakeLearner
from train_runs import Make, logged

from dreamer_spec.envs import ContractEnv
from dreamer_spec.envs.adapter import InvalidData
from dreamer_spec.envs.info import chosen, names_of
from dreamer_spec.errors import UserError
from dreamer_spec.training import loop


class Judged(train_fakes.Counting):
    """Says at every step how far it is, and more."""

    def step(self, action: np.ndarray) -> Any:
        *rest, _ = super().step(action)
        parts = {"alive": np.float32(0.5), "time": np.array([self._time])}
        return *rest, {
            "is_success": self._episode % 2 == 0,
            "parts": parts,
            "name": "judged",
            "frame": np.zeros((3, 3)),
        }


class Broken(train_fakes.Counting):
    def step(self, action: np.ndarray) -> Any:
        return *super().step(action)[:4], {"good": 1, "bad": np.nan if self._time == EPISODE else 0.0}


INFO = {
    "a": 1,
    "b": True,
    "c": {"d": np.float64(2.5), "e": {"f": np.array([3])}},
    "text": "x",
    "many": [1, 2],
    "none": None,
}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("", {}),
        ("a", {"a": 1.0}),
        ("a,b", {"a": 1.0, "b": 1.0}),
        ("c/d, c/e/f", {"c/d": 2.5, "c/e/f": 3.0}),
        ("c/*", {"c/d": 2.5, "c/e/f": 3.0}),
        ("*", {"a": 1.0, "b": 1.0, "c/d": 2.5, "c/e/f": 3.0}),
        ("absent", {}),
    ],
)
def test_names_and_patterns_choose_numbers(names: str, expected: dict[str, float]) -> None:
    assert chosen(INFO, names_of(names)).values == expected


@pytest.mark.parametrize("name", ["text", "many", "none"])
def test_what_is_named_must_be_a_number(name: str) -> None:
    with pytest.raises(UserError, match=rf"info\['{name}'\].*--info-metrics"):
        chosen(INFO, (name,))


@pytest.mark.parametrize("value", [np.nan, np.inf, np.array([-np.inf])])
@pytest.mark.parametrize("name", ["x", "*"])
def test_what_is_chosen_must_be_finite(name: str, value: Any) -> None:
    with pytest.raises(UserError, match=r"info\['x'\]"):
        chosen({"x": value}, (name,))


def test_what_is_not_chosen_may_be_anything() -> None:
    assert chosen({"x": np.nan, "y": object(), "z": 1}, ("z",)).values == {"z": 1.0}
    assert chosen(None, ("z",)).values == {}, "an environment that gives no dictionary"


def test_an_invalid_number_is_invalid_data_of_the_environment() -> None:
    env = ContractEnv(Broken(), "t", info_metrics=("good", "bad"))
    env.reset()
    for _ in range(EPISODE - 1):
        assert env.step(np.float32([0, 0]))[4] == {}, "only the last step counts"
    with pytest.raises(InvalidData, match=rf"task t, environment 0, step {EPISODE}.*'bad'"):
        env.step(np.float32([0, 0]))


@pytest.mark.parametrize("processes", ["no", "yes"])
def test_they_are_logged_with_episodes_and_evaluations(make: Make, processes: str) -> None:
    options = make(
        task="test_train_info:Judged", info_metrics="is_success,parts/*", eval_episodes=2, processes=processes, envs=2
    )
    loop.run(options, FakeLearner)
    episodes = [line for line in logged(options.logdir) if "episode/return" in line]
    assert len(episodes) > 2
    for line in episodes:
        number = (line["episode/return"] - EPISODE * (EPISODE + 1) / 2) / (10 * EPISODE)
        shown = {name: value for name, value in line.items() if name.startswith("episode/info/")}
        assert shown == {
            "episode/info/is_success": number % 2 == 0,
            "episode/info/parts/alive": 0.5,
            "episode/info/parts/time": EPISODE,
        }
    (evaluation,) = [line for line in logged(options.logdir) if "evaluation/return" in line]
    assert evaluation["evaluation/info/is_success"] == 1.0, "each of two environments plays its first episode"
    assert evaluation["evaluation/info/parts/time"] == EPISODE


def test_a_name_that_is_not_there_is_said_once(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    loop.run(make(task="test_train_info:Judged", info_metrics="is_succes,parts/*"), FakeLearner)
    (warning,) = [line for line in capsys.readouterr().out.splitlines() if "is_succes" in line]
    assert "WARNING" in warning
    assert "--info-metrics" in warning
