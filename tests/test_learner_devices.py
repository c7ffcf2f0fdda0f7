"""Which device a learner takes, and how many threads."""

import jax
import pytest
import torch

from conformance.problems import small_config, spaces
from impl_jax.learner import select_device as jax_device
from train.backend import Learner, learner_class

TASK = spaces("vector", "mixed")


def make(backend: str, device: str = "cpu", deter: int = 48) -> Learner:
    return learner_class(backend)(TASK, small_config("paper", "float32", deter=deter), seed=0, device=device)


@pytest.mark.parametrize("device", ["tpu9", "cpuu", "cuda:", "cudagpu", "cuda:99", "gpu:99"])
@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_unknown_devices_are_named(backend: str, device: str) -> None:
    with pytest.raises(ValueError, match=device):
        make(backend, device)


def test_jax_counts_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "devices", lambda kind=None: {"cpu": ["the processor"], "cuda": ["one", "two"], "gpu": ["one", "two"]}[kind])
    names = ("cpu", "gpu", "cuda", "cuda:0", "cuda:1", "gpu:1")
    assert [jax_device(name) for name in names] == ["the processor", "one", "one", "one", "two", "two"]
    for name in ("cuda:2", "gpu:10"):
        with pytest.raises(ValueError, match=f"'{name}'.*2 GPUs"):
            jax_device(name)


def test_a_large_learner_gets_back_the_threads_that_a_small_one_gave_up(monkeypatch: pytest.MonkeyPatch) -> None:
    before = torch.get_num_threads()
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("impl_torch.learner._THREADS", 3)
    try:
        counts = []
        for deter in (48, 768, 48):
            make("torch", deter=deter)
            counts.append(torch.get_num_threads())
    finally:
        torch.set_num_threads(before)
    assert counts == [1, 3, 1]
