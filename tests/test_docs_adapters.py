"""docs/adapters.md: its examples run, and adapters that are written as it says are judged rightly."""

import dataclasses
import json
import re
import sys
import types
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch
from adapters import CHECKS, CONFIG, run

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.adapters.torch_adapter import TorchAdapter
from conformance.adapters.without_noise import WithoutNoise
from conformance.candidate import ModuleAdapter
from conformance.serve import load_file
from impl_torch import world_model

TESTS = Path(__file__).resolve().parent
DOCUMENT = (TESTS.parent / "docs" / "adapters.md").read_text(encoding="utf-8")


# --- A third-party implementation
# ------------------------------------------------------------------------------

THIRD_PARTY = TESTS / "third_party_adapter.py"
PASSES = (
    *("returns.lambda_return_literals", "returns.lambda_return_matches", "returns.lambda_return_ignores_the_start"),
    *("transforms.twohot_literals", "world_model.kl_matches", "sampling.latents_have_their_frequencies"),
    *("rssm.gates_literals", "rssm.gates_are_split_inside_each_block", "rssm.core_matches"),
)


@pytest.mark.parametrize("name", PASSES)
def test_a_third_party_implementation_passes(name: str) -> None:
    """A code base that is time first, flat, and has layouts of its own, through an adapter of at most 60 lines."""
    assert len(THIRD_PARTY.read_text(encoding="utf-8").splitlines()) <= 60
    result = run(name, ModuleAdapter(load_file(THIRD_PARTY), "float64"))
    assert result.status == "pass", result.message


def test_a_mistake_of_a_third_party_implementation_is_found() -> None:
    """Its λ-return with the value of the state that is left: the paper's printed indices."""
    theirs = load_file(THIRD_PARTY)
    right = theirs.code.lambda_values
    late = types.SimpleNamespace(lambda_values=lambda rewards, values, *rest: right(rewards, values.roll(1, 0), *rest))
    theirs.code = late
    assert run("returns.lambda_return_matches", ModuleAdapter(theirs, "float64")).status == "fail"


# --- The document
# ------------------------------------------------------------------------------


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)


def mean_kl_losses(
    posterior: torch.Tensor, prior: torch.Tensor, free_nats: float, unimix: float
) -> tuple[torch.Tensor, torch.Tensor]:
    config = dataclasses.replace(CONFIG, free_nats=free_nats, latent_unimix=unimix)
    return tuple(loss.mean() for loss in world_model.kl_losses(posterior, prior, config))


def test_the_examples_of_the_document_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    example, means, given, draw, _, _ = blocks("python")  # the others: below, and in tests/test_own_tests.py
    mine = types.ModuleType("example")
    exec(example, vars(mine))
    adapter = ModuleAdapter(mine, "float64")
    for name in ("transforms.symlog_matches", "returns.lambda_return_matches", "layers.rms_norm_matches"):
        assert run(name, adapter).status == "pass", name
    averaging = types.ModuleType("averaging")
    monkeypatch.setitem(sys.modules, "my_code", types.SimpleNamespace(kl_losses=mean_kl_losses))
    exec(means, vars(averaging))
    assert run("world_model.kl_matches", ModuleAdapter(averaging, "float64"), "float32").status == "pass"
    assert averaging.convert(np.ones(2)).dtype == torch.float32
    assert averaging.convert(np.array([True])).dtype == torch.bool
    drawing = types.ModuleType("drawing")
    exec(draw, vars(drawing))
    assert run("sampling.normals_have_their_distribution", ModuleAdapter(drawing, "float64")).status == "pass"
    scope: dict[str, Any] = {}
    exec(given, scope)
    probs = torch.tensor([0.25, 0.75], requires_grad=True)
    sample = scope["Given"](probs, torch.tensor([1.0, 0.0])).rsample()
    sample[0].backward()
    assert sample.tolist() == [1, 0]
    assert probs.grad is not None
    assert probs.grad.tolist() == [1, 0]


LACKING = {  # what the loop of the document does not have
    *(
        "a_skipped_step_leaves_the_buffer_as_it_is",
        "evaluation_changes_nothing",
        "a_shared_environment_changes_nothing",
    ),
    *("evaluations_play_new_episodes_with_fresh_noise", "an_evaluation_is_the_mean_of_whole_episodes"),
    *("a_continued_run_is_the_run_in_one_go", "environments_that_lead_elsewhere_begin_anew"),
    *("a_warm_start_takes_over_what_was_learned", "scores_are_plain_sums"),
}


@pytest.mark.parametrize("name", [name for name in CHECKS if CHECKS[name].uses == ("run",)])
def test_the_loop_of_the_document_passes_in_what_it_has(name: str) -> None:
    (source,) = (block for block in blocks("python") if "def run(" in block)
    mine = types.ModuleType("loop")
    exec(source, vars(mine))
    result = run(name, ModuleAdapter(mine, "float64"))
    if name == "going_on.a_failed_environment_is_replaced":
        assert (result.status, "Broken" in result.message) == ("error", True)
        return
    assert (result.status == "not offered") == (name.partition(".")[2] in LACKING), result.message
    assert result.status in ("pass", "not offered"), result.message


def test_the_messages_of_the_document_are_valid() -> None:
    schema = json.loads((TESTS.parent / "conformance" / "protocol.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    lines = [json.loads(line) for line in blocks("json")[0].splitlines()]
    kinds = ("request", "start_reply", "request", "run_reply", "request", "error_reply")
    for kind, message in zip(kinds, lines, strict=True):
        jsonschema.Draft202012Validator({"$ref": f"#/$defs/{kind}", "$defs": schema["$defs"]}).validate(message)


# --- Given samples
# ------------------------------------------------------------------------------


class Given(WithoutNoise, TorchAdapter):
    """The PyTorch backend with given samples."""

    def gradients_given(
        self, params: Any, slow_critic: Any, return_range: Any, batch: Any, samples: Any, *rest: Any
    ) -> Any:
        return self.gradients(
            params, slow_critic, return_range, batch, self.noise_of(params, batch, samples, *rest), *rest
        )

    def train_step_given(self, state: Any, batch: Any, samples: Any, *rest: Any) -> Any:
        return self.train_step(state, batch, self.noise_of(state["params"], batch, samples, *rest), *rest)


class Forgetful(NumpyAdapter):
    """Never resets."""

    def observe_given(self, params: Any, carry: Any, tokens: Any, prev_action: Any, is_first: Any, *rest: Any) -> Any:
        return super().observe_given(params, carry, tokens, prev_action, np.zeros_like(is_first), *rest)


class Ignorant(NumpyAdapter):
    """Imagines with other latents than those given."""

    def imagine_given(self, params: Any, carry: Any, action: Any, stoch: Any, config: Any) -> Any:
        return super().imagine_given(params, carry, action, np.roll(stoch, 1, -1), config)


class Early(NumpyAdapter):
    """Gives the prior logits of the state before."""

    def observe_given(self, *arguments: Any) -> Any:
        result = super().observe_given(*arguments)
        return result | {"prior": np.roll(result["prior"], 1, 1)}


@pytest.mark.parametrize("name", [name for name in CHECKS if name.startswith("given.")])
def test_an_implementation_with_given_samples_passes(name: str) -> None:
    result = run(name, Given("float64", "cpu"))
    assert result.status == "pass", result.message


@pytest.mark.parametrize(
    ("mistaken", "name"),
    [
        (Forgetful, "observe_given_matches"),
        (Early, "observe_given_matches"),
        (Ignorant, "imagine_given_matches"),
        (Ignorant, "critic_matches"),
    ],
)
def test_mistakes_with_given_samples_are_found(mistaken: type[NumpyAdapter], name: str) -> None:
    assert run(f"given.{name}", mistaken()).status == "fail"
