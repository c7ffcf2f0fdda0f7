"""Which device a learner takes."""

import jax
import pytest

from conformance.problems import small_config, spaces
from dreamer_spec.backend import Learner, learner_class
from impl_jax.learner import select_device as jax_device

TASK = spaces("vector", "mixed")


def make(backend: str, device: str = "cpu") -> Learner:
    return learner_class(backend)(TASK, small_config("paper", "float32"), seed=0, device=device)


@pytest.mark.parametrize("device", ["tpu9", "cpuu", "cuda:", "cudagpu", "cuda:99", "gpu:99"])
@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_unknown_devices_are_named(backend: str, device: str) -> None:
    with pytest.raises(ValueError, match=device):
        make(backend, device)


def test_jax_counts_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        jax,
        "devices",
        lambda kind=None: {"cpu": ["the processor"], "cuda": ["one", "two"], "gpu": ["one", "two"]}[kind],
    )
    names = ("cpu", "gpu", "cuda", "cuda:0", "cuda:1", "gpu:1")
    assert [jax_device(name) for name in names] == ["the processor", "one", "one", "one", "two", "two"]
    for name in ("cuda:2", "gpu:10"):
        with pytest.raises(ValueError, match=f"'{name}'.*2 GPUs"):
            jax_device(name)
