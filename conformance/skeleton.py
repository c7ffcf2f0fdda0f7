"""A commented module to start an adapter from, made of the interface and of what the reference says of each function."""

import importlib
import inspect
import re
import textwrap
from importlib import resources

from conformance.adapter import INTERFACE, Adapter, Hooks

HEADER = '''"""An adapter: what `conformance check {name}` calls.

Uncomment what your implementation offers and call your own code in it. Everything is optional. Arrays come in as NumPy, rows first and
time second; give back arrays of any library. `docs/adapters.md` of dreamer-spec explains the rest. Good first functions: lambda_return,
kl_losses, symexp_twohot_loss and core, where most mistakes are.

In the shapes: B sequences of T steps, N starts of H imagined steps, D memory units, S latents of C classes, A numbers of a flat action.
`params` is a dict from canonical names (`rssm/gru/kernel`) to arrays: your function brings them into its own layers first.
"""
'''
ROWS = (
    *("transforms", "distributions", "layers", "rssm", "networks", "world_model"),
    *("returns", "behavior", "optimizer", "agent", "replay", "training_loop"),
)


def skeleton(name: str) -> str:
    """The source of a module that offers nothing yet, for an adapter with the given file name."""
    parts = [
        HEADER.format(name=name),
        _title("what is not part of the algorithm"),
        *(_commented(hook, getattr(Hooks, hook)) for hook in HOOKS),
    ]
    for row, functions in functions_by_row().items():
        parts += [_title(f"{row.replace('_', ' ')}: spec/{chapter(row)}"), *(_commented(name, described(name)) for name in functions)]
    return "\n".join(parts)


HOOKS = tuple(name for name, hook in vars(Hooks).items() if inspect.isfunction(hook) and not name.startswith("_"))


def functions_by_row() -> dict[str, list[str]]:
    """Row of the grid -> its functions of the interface. What the reference lacks belongs to the row of the one before."""
    modules = {row: importlib.import_module(f"reference_numpy.{row}") for row in ROWS}
    found: dict[str, list[str]] = {row: [] for row in ROWS}
    current = ROWS[0]
    for name in INTERFACE:
        current = next((row for row, module in modules.items() if _defined_in(module, name)), current)
        found[current].append(name)
    return found


def chapter(row: str) -> str:
    """The file of a row's chapter."""
    return next(path.name for path in resources.files("spec").iterdir() if re.fullmatch(rf"\d\d-{row.replace('_', '-')}\.md", path.name))


def described(name: str) -> object:
    """Where a function of the interface is described: in the interface itself, or else in the reference."""
    function = getattr(Adapter, name)
    if inspect.getdoc(function):
        return function
    modules = (importlib.import_module(f"reference_numpy.{row}") for row in ROWS)
    return next(getattr(module, name) for module in modules if _defined_in(module, name))


def _defined_in(module: object, name: str) -> bool:
    return getattr(getattr(module, name, None), "__module__", None) == getattr(module, "__name__", "")


def _title(text: str) -> str:
    return f"\n# --- {text} ".ljust(100, "-") + "\n"


def _commented(name: str, documented: object) -> str:
    function = getattr(Hooks, name) if name in HOOKS else getattr(Adapter, name)
    arguments = ", ".join(list(inspect.signature(function).parameters)[1:])
    source = f"def {name}({arguments}):\n{textwrap.indent(_brief(documented), '    ')}\n    raise NotImplementedError\n"
    return "".join(f"# {line}".rstrip() + "\n" for line in source.splitlines())


def _brief(documented: object) -> str:
    """The docstring of a function: its first sentence, arguments and results, without requirement ids and sources."""
    first, *rest = (inspect.getdoc(documented) or "").split("\n\n")
    sections = [section for section in rest if section.startswith(("Args:", "Returns:"))]
    meaning = re.sub(r"\s+", " ", re.sub(r"Implements \[.*?\](?:(?:, | to | and )\[.*?\])*[^.\[]*\.?", "", first, flags=re.DOTALL)).strip()
    text = "\n\n".join([meaning, *sections])
    return f'"""{text}\n"""' if sections else f'"""{text}"""'
