"""A commented module to start an adapter from, made of the interface and of what the reference says of each
function."""

import importlib
import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from importlib import resources

from conformance.adapter import Adapter, Hooks
from conformance.interface import CONFIG_FIELDS, INTERFACE

HEADER = '''"""An adapter: what `conformance check {name}` calls.

Uncomment what your implementation offers and call your own code in it. Everything is optional. Arrays come in as
NumPy, rows first and time second; give back arrays of any library. `docs/adapters.md` of dreamer-spec explains the
rest. Good first functions: lambda_return, kl_losses, symexp_twohot_loss and core, where most mistakes are.

Numbers that come as arguments, and those of `config`, vary from call to call: hand them on, as a number written into
the code fails. Where `config` makes a choice that your code does not have, raise NotImplementedError("which one").

In the shapes: B sequences of T steps, N starts of H imagined steps, D memory units, S latents of C classes, A numbers
of a flat action. `params` is a dict from canonical names (`rssm/gru/kernel`) to arrays: your function brings them
into its own layers first.
"""
'''
CHAPTERS = (
    *("transforms", "distributions", "layers", "rssm", "networks", "world_model"),
    *("returns", "behavior", "optimizer", "agent", "replay", "training_loop"),
)


FIRST = (
    *(
        "symlog",
        "symexp",
        "unimix_log_probs",
        "symexp_twohot_loss",
        "symexp_twohot_mean",
        "core",
        "kl_losses",
        "lambda_return",
    ),
    *("cumulative_weights", "update_return_range", "return_scale", "actor_loss", "critic_loss"),
)
"""Functions to begin with: most code bases have them apart, and most mistakes are in them."""


def skeleton(name: str, short: bool = False) -> str:
    """The source of a module that offers nothing yet, for an adapter of that file name. short: it describes only the
    FIRST functions."""
    parts = [
        HEADER.format(name=name),
        _title("what is not part of the algorithm"),
        *(_commented(hook, getattr(Hooks, hook)) for hook in HOOKS),
    ]
    chapters = functions_by_chapter()
    for chapter, functions in chapters.items():
        if chosen := [name for name in functions if name in FIRST or not short]:
            parts += [
                _title(f"{chapter.replace('_', ' ')}: spec/{chapter_file(chapter)}"),
                *(_commented(name, described(name)) for name in chosen),
            ]
    return "\n".join([*parts, *([_others(chapters)] if short else [])])


def _others(chapters: Mapping[str, Sequence[str]]) -> str:
    """A comment that names the functions which are not among the FIRST."""
    title = _title("what else can be offered: `conformance new-adapter` without --short describes it")
    lines = (
        f"{chapter.replace('_', ' ')}: {', '.join(name for name in functions if name not in FIRST)}"
        for chapter, functions in chapters.items()
    )
    wrapped = (
        textwrap.fill(line, 100, initial_indent="# ", subsequent_indent="#   ", break_on_hyphens=False)
        for line in lines
    )
    return title + "\n" + "\n".join(wrapped) + "\n"


HOOKS = tuple(name for name, hook in vars(Hooks).items() if inspect.isfunction(hook) and not name.startswith("_"))


def functions_by_chapter() -> dict[str, list[str]]:
    """Chapter -> its functions of the interface. What the reference lacks belongs to the chapter of the function
    before."""
    modules = {chapter: importlib.import_module(f"reference_numpy.{chapter}") for chapter in CHAPTERS}
    found: dict[str, list[str]] = {chapter: [] for chapter in CHAPTERS}
    current = CHAPTERS[0]
    for name in INTERFACE:
        current = next((chapter for chapter, module in modules.items() if _defined_in(module, name)), current)
        found[current].append(name)
    return found


def chapter_file(chapter: str) -> str:
    """The name of a chapter's file."""
    return next(
        path.name
        for path in resources.files("spec").iterdir()
        if re.fullmatch(rf"\d\d-{chapter.replace('_', '-')}\.md", path.name)
    )


def described(name: str) -> object:
    """Where a function of the interface is described: in the interface itself, or else in the reference."""
    function = getattr(Adapter, name)
    if inspect.getdoc(function):
        return function
    modules = (importlib.import_module(f"reference_numpy.{chapter}") for chapter in CHAPTERS)
    return next(getattr(module, name) for module in modules if _defined_in(module, name))


def _defined_in(module: object, name: str) -> bool:
    return getattr(getattr(module, name, None), "__module__", None) == getattr(module, "__name__", "")


def _title(text: str) -> str:
    return f"\n# --- {text} ".ljust(100, "-") + "\n"


def _commented(name: str, documented: object) -> str:
    function = getattr(Hooks, name) if name in HOOKS else getattr(Adapter, name)
    arguments = ", ".join(list(inspect.signature(function).parameters)[1:])
    docstring = _brief(documented, CONFIG_FIELDS.get(name, ()))
    source = f"def {name}({arguments}):\n{textwrap.indent(docstring, '    ')}\n    raise NotImplementedError\n"
    return "".join(f"# {line}".rstrip() + "\n" for line in source.splitlines())


def _brief(documented: object, fields: Sequence[str]) -> str:
    """The docstring of a function: its first sentence, arguments and results, without requirement ids and sources.

    fields: of the configuration, which its arguments end with.
    """
    first, *rest = (inspect.getdoc(documented) or "").split("\n\n")
    sections = [section for section in rest if section.startswith(("Args:", "Returns:"))]
    if fields:
        config = textwrap.fill(f"config: {', '.join(fields)}.", 100, initial_indent="  ", subsequent_indent="    ")
        sections = [f"{section}\n{config}" if section.startswith("Args:") else section for section in sections]
    sentences = " ".join(first.split())
    meaning = re.sub(r" ?Implements \[.*?\](?:(?:, | to | and )\[.*?\])*[^.\[]*\.?", "", sentences).strip()
    text = "\n\n".join([meaning, *sections])
    return f'"""{text}\n"""' if sections else f'"""{text}"""'
