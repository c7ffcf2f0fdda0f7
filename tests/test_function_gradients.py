"""What flows back through the functions of somebody else's adapter, in PyTorch and JAX, without a line of theirs."""

import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import conformance.cases  # noqa: F401 - registers the checks
from conformance.candidate import load_candidate
from conformance.case import Setting
from conformance.check import CHECKS
from conformance.execute import Result, run_check
from conformance.offered import without_gradients
from conformance.process import ProcessAdapter

SETTING = Setting("float64", "paper", 0, 2)

TORCH = """
    import torch

    convert = torch.as_tensor


    def probs(logits, unimix):
        return (1 - unimix) * torch.softmax(logits, -1) + unimix / logits.shape[-1]


    def kl(p, q):
        return (p * (p.log() - q.log())).sum((-1, -2))
"""
KL = """
    def kl_losses(posterior, prior, config):
        p, q = probs(posterior, config.latent_unimix), probs(prior, config.latent_unimix)
        dynamics, representation = kl(p.detach(), q), kl(p, q.detach())
        return {"dynamics": dynamics.clip(config.free_nats), "representation": representation.clip(config.free_nats)}
"""
SAMPLER = """
    def draw_categorical(logits, unimix, seed, n):
        generator = torch.Generator().manual_seed(seed)
        p = probs(logits, unimix)
        drawn = torch.multinomial(p.detach(), n, replacement=True, generator=generator).T
        sample = torch.nn.functional.one_hot(drawn, p.shape[-1]).to(p)
        return sample + (p - p.detach())
"""
RELAXED = """
    def draw_categorical(logits, unimix, seed, n):
        torch.manual_seed(seed)
        return torch.nn.functional.gumbel_softmax(probs(logits, unimix).log().expand(n, -1, -1), hard=True)
"""
DETACHED = KL.replace("p, q = ", "posterior, prior = posterior.detach(), prior.detach(); p, q = ")
JAX = """
    import jax
    import jax.numpy as jnp

    convert = jnp.asarray


    def actor_loss(log_prob, entropy, returns, value, weight, scale, config):
        constant = jax.lax.stop_gradient
        advantage = constant((returns - value) / scale)
        return -constant(weight) * (advantage * log_prob + config.entropy_scale * entropy)
"""


def judge(tmp_path: Path, source: str, check: str) -> Result:
    path = tmp_path / "an_adapter.py"
    path.write_text(textwrap.dedent(source))
    return run_check(CHECKS[f"function_gradients.gradient_of_{check}"], load_candidate(str(path), "float64"), SETTING)


@pytest.mark.parametrize(
    ("source", "check"),
    [(TORCH + KL, "the_kl_losses"), (TORCH + SAMPLER, "the_own_sampler"), (JAX, "the_actor_loss")],
)
def test_right_gradients_pass(tmp_path: Path, source: str, check: str) -> None:
    result = judge(tmp_path, source, check)
    assert result.status == "pass", result.message
    assert result.compared >= 4


@pytest.mark.parametrize(
    ("source", "check", "words"),
    [
        (
            TORCH + KL.replace("kl(p.detach(), q), kl(p, q.detach())", "kl(p, q.detach()), kl(p.detach(), q)"),
            "the_kl_losses",
            "gradient of kl_losses by posterior_logits",
        ),
        (TORCH + RELAXED, "the_own_sampler", "gradient of draw_categorical by logits"),
        (JAX.replace("constant((returns", "((returns"), "the_actor_loss", "gradient of actor_loss by returns"),
        (JAX.replace("-constant(weight)", "-weight"), "the_actor_loss", "gradient of actor_loss by weight"),
    ],
)
def test_wrong_gradients_fail_where_the_values_are_right(tmp_path: Path, source: str, check: str, words: str) -> None:
    result = judge(tmp_path, source, check)
    assert result.status == "fail"
    assert words in result.message


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        (KL.replace("p, q = ", "posterior = torch.as_tensor(posterior.numpy()); p, q = "), "its tensors leave PyTorch"),
        (DETACHED, "its results have none"),
        (
            DETACHED.replace("dynamics, rep", "p, q = p.requires_grad_(), q; dynamics, rep"),
            "do not come from the tensors that it was given",
        ),
    ],
)
def test_gradients_that_cannot_be_seen_count_as_not_offered(tmp_path: Path, source: str, reason: str) -> None:
    result = judge(tmp_path, TORCH + source, "the_kl_losses")
    assert result.status == "not offered"
    assert reason in result.message


def test_whole_numbers_and_functions_that_jax_cannot_trace_show_no_gradient(tmp_path: Path) -> None:
    indices = SAMPLER.replace("return sample + (p - p.detach())", "return drawn")
    assert "not real numbers" in judge(tmp_path, TORCH + indices, "the_own_sampler").message
    with_numpy = JAX.replace("advantage = ", "import numpy as np; returns = np.asarray(returns); advantage = ")
    result = judge(tmp_path, with_numpy, "the_actor_loss")
    assert result.status == "not offered"
    assert "JAX cannot trace it" in result.message


def test_arrays_of_numpy_have_no_gradient(tmp_path: Path) -> None:
    source = "import numpy as np\n\n\ndef silu(x):\n    return x / (1 + np.exp(-x))\n"
    path = tmp_path / "plain.py"
    path.write_text(source)
    assert not hasattr(load_candidate(str(path), "float64"), "vjp")
    path.write_text(source + "\n\nconvert = np.asarray\n")
    with pytest.raises(NotImplementedError, match="neither PyTorch nor JAX"):
        load_candidate(str(path), "float64").vjp("silu", (np.zeros(2),), np.ones(2))


def test_a_process_shows_them_too(tmp_path: Path) -> None:
    path = tmp_path / "far.py"
    path.write_text(textwrap.dedent(TORCH + KL))
    adapter: Any = ProcessAdapter(f"{sys.executable} -m conformance.serve {path}", "float64", 60)
    try:
        result = run_check(CHECKS["function_gradients.gradient_of_the_kl_losses"], adapter, SETTING)
    finally:
        adapter.close()
    assert result.status == "pass", result.message


def test_the_report_says_whose_gradients_nobody_saw(tmp_path: Path) -> None:
    values, gradients = CHECKS["world_model.kl_matches"], CHECKS["function_gradients.gradient_of_the_kl_losses"]
    path = tmp_path / "an_adapter.py"
    path.write_text(textwrap.dedent(TORCH + DETACHED))
    adapter = load_candidate(str(path), "float64")
    assert without_gradients([run_check(check, adapter, SETTING) for check in (values, gradients)]) == ["kl_losses"]
    path.write_text(textwrap.dedent(TORCH + KL))
    seen = load_candidate(str(path), "float64")
    assert without_gradients([run_check(check, seen, SETTING) for check in (values, gradients)]) == []
    assert without_gradients([run_check(values, seen, SETTING)]) == ["kl_losses"]
