"""Adapters that are modules, and those that map state: other code is understood, and its mistakes are found."""

import dataclasses
import inspect
import types
from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from adapters import CHECKS, CONFIG, module, run

from conformance import candidate
from conformance.adapter import Adapter
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.candidate import ModuleAdapter, remarks
from conformance.case import Setting
from conformance.errors import UserError
from conformance.execute import run_check
from conformance.foreign import arranged
from conformance.interface import INTERFACE, OBJECTS, RESULTS
from conformance.our_candidates import load_adapter
from conformance.reports import summary
from conformance.serve import load_file, to_numpy
from reference_numpy import networks
from spec import Config

# --- What comes back
# ------------------------------------------------------------------------------


def test_tensors_come_back_as_numpy() -> None:
    half = np.array([0.5, -2.0])
    tensor = torch.tensor(half, requires_grad=True)
    for value in (
        tensor,
        tensor * 1,
        tensor.to(torch.bfloat16),
        tensor.float(),
        np.float16(half),
        load_jax().asarray(half, "bfloat16"),
    ):
        array = to_numpy(value)
        assert isinstance(array, np.ndarray)
        np.testing.assert_array_equal(array, half)
    assert to_numpy(torch.tensor([True, False])).dtype == bool
    assert to_numpy(torch.tensor([3])).dtype == np.int64


def load_jax() -> Any:
    import jax.numpy as jnp

    return jnp


@dataclasses.dataclass
class Losses:
    representation: Any
    dynamics: Any


Normal = namedtuple("Normal", ["std", "mean"])


class Items:
    """Like a TensorDict: a mapping that is none."""

    def items(self) -> Any:
        return {"dynamics": 1.0, "representation": 2.0}.items()


def test_several_results_come_in_any_dress() -> None:
    losses = (np.zeros(2), np.zeros(2), CONFIG)
    for result in ((1.0, 2.0), [1.0, 2.0], {"representation": 2.0, "dynamics": 1.0}, Losses(2.0, 1.0), Items()):
        assert arranged("kl_losses", losses, to_numpy(result)) == (1.0, 2.0)
    assert arranged("bounded_normal", (), to_numpy(Normal(2.0, 1.0))) == (1.0, 2.0)
    for result, got in (
        ((1.0,), "a tuple of 1"),
        ({"dyn": 1, "rep": 2}, "a dict with the keys 'dyn', 'rep'"),
        (np.ones(2), "one array of shape \\[2\\]"),
    ):
        with pytest.raises(
            TypeError,
            match=rf"kl_losses: expected a tuple \(dynamics, representation\) or a dict with these keys, got {got}",
        ):
            arranged("kl_losses", losses, to_numpy(result))
    with pytest.raises(TypeError, match="symlog: expected one array, got a dict with the keys 'x'"):
        arranged("symlog", (np.ones(2),), {"x": np.ones(2)})
    with pytest.raises(TypeError, match="symlog: expected one array, got a tuple of parts that do not stack"):
        arranged("symlog", (np.ones(2),), to_numpy([[1.0, 2.0], [3.0]]))
    with pytest.raises(TypeError, match="observe: expected a dict of arrays, got a tuple of 3"):
        arranged("observe", (CONFIG,), (1, 2, 3))


def test_latents_come_flat_or_as_indices() -> None:
    indices = np.array([[0, 4, 2], [1, 1, 3]])
    onehot = np.eye(5)[indices]
    for latents in (onehot, onehot.reshape(2, 15), indices, indices.astype(np.int32)):
        np.testing.assert_array_equal(arranged("posterior", (CONFIG,), latents), onehot)
        np.testing.assert_array_equal(
            arranged("observe", (CONFIG,), {"stoch": latents, "deter": indices})["stoch"], onehot
        )
        np.testing.assert_array_equal(
            arranged("policy_step", (CONFIG,), ({"stoch": latents}, indices))[0]["stoch"], onehot
        )
    assert arranged("observe", (CONFIG,), {"deter": indices})["deter"] is indices
    np.testing.assert_array_equal(arranged("categorical_sample", (np.zeros((2, 3, 5)), None), indices), onehot)
    np.testing.assert_array_equal(arranged("draw_categorical", (np.zeros((3, 5)), 0.0, 0, 2), indices), onehot)
    for wrong in (indices - 1, indices + 1):
        with pytest.raises(TypeError, match=r"class indices in 0 .. 4, got"):
            arranged("posterior", (CONFIG,), wrong)
    real = indices.astype(float)  # whole numbers only: reals could be logits of another shape
    assert arranged("posterior", (CONFIG,), real) is real


def test_every_tuple_has_names() -> None:
    annotated = {
        name
        for name in INTERFACE
        if str(inspect.signature(getattr(Adapter, name)).return_annotation).startswith("tuple")
    }
    assert annotated == set(RESULTS)
    assert set(OBJECTS) < set(INTERFACE)


def lambda_return(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Any:
    reference: Any = load_adapter("numpy")
    return reference.lambda_return(reward, continue_, value, discount, lambda_)


def test_shapes_are_explained() -> None:
    """Expected, got, and the usual reason, of the function and the worked number."""
    where = "lambda_return, a return by hand"
    swapped = run(
        "returns.lambda_return_literals", module(lambda_return=lambda *arguments: lambda_return(*arguments).T)
    )
    assert swapped.message == f"{where}: expected shape (1, 3), got (3, 1): rows come first and time comes second"
    longer = run(
        "returns.lambda_return_literals", module(lambda_return=lambda *arguments: lambda_return(*arguments)[..., None])
    )
    assert longer.message == f"{where}: expected shape (1, 3), got (1, 3, 1): leave out the last axis"
    shorter = run(
        "returns.lambda_return_literals", module(lambda_return=lambda *arguments: lambda_return(*arguments)[:, 1:])
    )
    assert shorter.message == f"{where}: expected shape (1, 3), got (1, 2)"


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda reward, value: reward,
            "lambda_return is called with (reward, continue_, value, discount, lambda_), in this order; yours takes",
        ),
        (lambda *arguments: None, "lambda_return: expected numbers, got None: is a `return` missing?"),
        (lambda *arguments: "done", "lambda_return: expected numbers, got str"),
        (lambda *arguments: {"returns": 1.0}, "lambda_return: expected one array, got a dict with the keys 'returns'"),
    ],
)
def test_mistakes_in_an_adapter_are_explained(function: Any, message: str) -> None:
    result = run("returns.lambda_return_literals", module(lambda_return=function))
    assert result.status == "error"
    assert message in result.message


def test_convert_is_applied_to_every_array() -> None:
    kinds = []

    def core(params: Any, deter: Any, stoch: Any, action: Any, config: Any) -> Any:
        kinds.extend(type(x) for x in (*params.values(), deter, stoch, action, config))
        return deter

    run("rssm.gates_literals", module(core=core, convert=torch.as_tensor))
    assert set(kinds) == {torch.Tensor, Config}


def test_a_number_for_an_array_is_an_array() -> None:
    """So that `x.shape` and `x.dtype` are there; what is a number in the interface stays one."""
    seen: list[Any] = []

    def normal_sample(mean: Any, std: Any, normal: Any) -> Any:
        seen.extend((mean, std, normal))
        return mean + std * normal

    def percentile(values: Any, q: Any) -> Any:
        seen.append(q)
        return q

    adapter = module(normal_sample=normal_sample, percentile=percentile)
    assert adapter.normal_sample(0.5, np.array(2.0), -1) == -1.5
    assert [type(value) for value in seen] == [np.ndarray] * 3
    assert [value.shape for value in seen] == [()] * 3
    assert adapter.percentile(np.zeros(3), 5.0) == 5.0
    assert type(seen[3]) is float


def test_setup_and_what_an_adapter_says_of_itself() -> None:
    seen = []
    mine = types.ModuleType("mine")
    exec("def lambda_returns(x): ...\ndef symlog_(x): ...\ndef my_helper(x): ...\ndef _symexp(x): ...", vars(mine))
    mine.__version__, mine.setup, mine.edition = "2", seen.append, lambda: "official"  # type: ignore[attr-defined]
    adapter = ModuleAdapter(mine, "float32")
    assert seen == ["float32"]
    assert remarks(adapter) == [
        "mine 2 claims the edition official",
        "lambda_returns is not a function of the interface; is lambda_return meant?",
        "symlog_ is not a function of the interface; is symlog meant?",
    ]
    assert remarks(load_adapter("numpy")) == []


def test_a_field_that_a_configuration_lacks_is_answered_with_those_that_are_near() -> None:
    def kl_losses(posterior_logits: Any, prior_logits: Any, config: Any) -> Any:
        return config.free_bits

    result = run("world_model.kl_literals", module(kl_losses=kl_losses))
    assert result.status == "error"
    assert summary.cause(result.message).splitlines() == [
        "AttributeError: 'Config' object has no attribute 'free_bits'",
        "is free_nats meant instead of free_bits?",
    ]
    with pytest.raises(AttributeError) as error:
        module(kl_losses=lambda posterior_logits, prior_logits, config: config.qqqq).kl_losses(0, 0, CONFIG)
    assert error.value.__notes__[0].startswith("there are: actor_layers, ")
    with pytest.raises(AttributeError) as error:
        module(symlog=lambda x: x.qqqq).symlog(np.ones(2))
    assert not hasattr(error.value, "__notes__")


class PoolsOnly(NumpyAdapter):
    """The reference without strided convolutions, as somebody else's program."""

    refuses_anyhow = True

    def encoder(self, params: Any, observation: Any, task: Any, config: Config) -> Any:
        if task.images and config.cnn_sampling == "strided":
            raise NotImplementedError("strided convolutions")
        return networks.encoder(params, observation, task, config)


def test_what_is_not_implemented_is_not_offered_and_the_other_cases_are_judged() -> None:
    names = ("encoder_matches", "encoder_with_other_convolutions_matches")
    for profile, own in (("official", ("pass", False)), ("paper", ("not offered", False))):
        results = [run_check(CHECKS[f"networks.{name}"], PoolsOnly(), Setting("float64", profile)) for name in names]
        assert [(result.status, result.is_partial) for result in results] == [own, ("pass", True)]
        assert {result.message for result in results if result.message} == {
            "not implemented: encoder (strided convolutions)"
        }
    rest = [check for name, check in CHECKS.items() if name.startswith("networks.") and "encoder" in check.uses]
    found = {
        check.name
        for check in rest
        if run_check(check, PoolsOnly(), Setting("float64", "official")).status == "not offered"
    }
    assert found == {"networks.brightness_literals"}


def test_our_own_implementations_have_no_such_excuse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PoolsOnly, "refuses_anyhow", False)
    assert run("networks.encoder_matches", PoolsOnly()).status == "error"


def test_what_is_not_implemented_is_no_failure_of_a_drawn_case() -> None:
    def symlog(x: Any) -> Any:
        raise NotImplementedError

    result = run("transforms.symlog_matches", module(symlog=symlog))
    assert (result.status, result.message) == ("not offered", "not implemented: symlog")


def test_an_edition_is_a_name() -> None:
    with pytest.raises(UserError, match="edition: expected a name or nothing, got 3"):
        module(edition=lambda: 3).edition()


def test_an_adapter_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "folder.py").mkdir()
    for name in ("mine.py", "folder.py"):
        with pytest.raises(UserError, match=rf"conformance new-adapter .*{name}"):
            candidate.load_candidate(str(tmp_path / name), "float64")
    for name in ("no_such_module", "./adapter", "..", "my adapter", ""):
        with pytest.raises(UserError, match="no module named"):
            candidate.load_candidate(name, "float64")


def test_an_adapter_with_a_dataclass(tmp_path: Path) -> None:
    """Annotations as text are looked up in the module, by its name."""
    source = (
        "from __future__ import annotations\nimport "
        "dataclasses\n\n\n@dataclasses.dataclass\nclass Losses:\n    dynamics: float\n"
    )
    (tmp_path / "with_a_dataclass.py").write_text(source, encoding="utf-8")
    assert load_file(tmp_path / "with_a_dataclass.py").Losses(1.0).dynamics == 1


def test_an_adapter_does_not_end_the_kit(tmp_path: Path) -> None:
    """Least of all with exit code 0."""

    def leave(x: Any) -> Any:
        raise SystemExit(0)

    result = run("transforms.symlog_matches", module(symlog=leave))
    assert result.status == "error"
    assert "symlog called sys.exit(0)" in result.message
    (tmp_path / "script.py").write_text("import sys\nsys.exit(0)\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"script\.py calls sys\.exit\(0\) when it is loaded"):
        candidate.load_candidate(str(tmp_path / "script.py"), "float64")
