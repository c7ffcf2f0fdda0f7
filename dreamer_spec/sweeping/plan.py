"""What a sweep consists of: every combination of what varies, each a run with a command line of its own."""

import collections
import dataclasses
import itertools
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dreamer_spec import arguments as keywords
from dreamer_spec.cli import parse
from dreamer_spec.disk.files import read_text
from dreamer_spec.errors import UserError
from dreamer_spec.kinds import FLAG, SEEDS
from dreamer_spec.option_table import ENV_ARG, Option, checked, options_by_group
from dreamer_spec.options import Options, default_logdir, did_you_mean

TABLES = ("logdir", "jobs", "options", "vary", "ray")
OF_THE_SWEEP = ("logdir", "resume", "seeds")  # options of `train` that a sweep gives its runs itself
MOST_RUNS = 10_000
LONGEST_NAME = 200  # bytes of the name of a run; file systems allow 255, with endings
IN_NAMES = ("backend", "task", "seed")  # part of every name


@dataclasses.dataclass(frozen=True)
class Item:
    """One run. name: of its folder. command: the words after `train`. options: what they mean."""

    name: str
    command: tuple[str, ...]
    options: Options


@dataclasses.dataclass(frozen=True)
class Plan:
    """logdir: below which each run has a folder. jobs: runs at once. ray: arguments of `ray.remote`, such as num_gpus;
    None for processes on this machine."""

    logdir: Path
    jobs: int
    items: tuple[Item, ...]
    ray: Mapping[str, Any] | None = None


def read_plan(path: Path, logdir: Path | None = None, jobs: int | None = None) -> Plan:
    """The sweep that a TOML file describes. logdir, jobs: in place of those of the file.

    Raises:
      UserError: the file cannot be read, or what is wrong in it, by its key.
    """
    try:
        content = tomllib.loads(read_text(path))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: {error}") from error
    try:
        return make_plan(content, logdir, jobs)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def make_plan(content: Mapping[str, Any], logdir: Path | None = None, jobs: int | None = None) -> Plan:
    """The sweep of the tables `options` and `vary`; see docs/sweeps.md.

    Raises:
      UserError: an unknown key, an option that no run has, a combination that is no run, or two runs of one name.
    """
    for name in content:
        if name not in TABLES:
            raise UserError(f"unknown key {name!r}{did_you_mean(name, TABLES)}; expected {', '.join(TABLES)}")
    given, vary, ray = (_table(content, name) for name in ("options", "vary", "ray"))
    varied = {name: _values(name, values) for name, values in vary.items()}
    if both := set(given) & set(varied):
        raise UserError(f"{', '.join(sorted(both))} stands in [options] and in [vary]; once is enough")
    logdir = logdir or _folder(content.get("logdir", "runs/sweep"))
    if (count := math.prod(map(len, varied.values()))) > MOST_RUNS:
        raise UserError(f"[vary] has {count:,} combinations; expected at most {MOST_RUNS:,}")
    combinations = itertools.product(*varied.values())
    items = tuple(_item(logdir, given, dict(zip(varied, values, strict=True))) for values in combinations)
    for name, times in collections.Counter(item.name for item in items).items():
        if times > 1:
            raise UserError(f"{times} runs have the name {name}: their values look alike; each must stand once")
    return Plan(
        logdir, _jobs(content.get("jobs", 1) if jobs is None else jobs), items, ray if "ray" in content else None
    )


def _table(content: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = content.get(name, {})
    if not isinstance(table, dict):
        raise UserError(f"{name} is {table!r:.80}; expected a table, [{name}]")
    return table


def _values(name: str, values: Any) -> list[Any]:
    if name == "seed" and isinstance(values, str):
        return list(SEEDS.of_value("vary.seed", values))
    if not isinstance(values, list) or not values:
        raise UserError(f"vary.{name} is {values!r:.80}; expected a list of values, at least one")
    return values


def _folder(value: Any) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise UserError(f"logdir is {value!r:.80}; expected the name of a folder")
    return Path(value)


def _jobs(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise UserError(f"jobs is {value!r:.80}; expected a whole number of at least 1")
    return value


def _item(logdir: Path, given: Mapping[str, Any], varied: Mapping[str, Any]) -> Item:
    known = {option.name: option for options in options_by_group().values() for option in options}
    values = {**given, **varied}
    if taken := next((name for name in OF_THE_SWEEP if name in values), None):
        raise UserError(f"the option {taken} is the sweep's own: a sweep has `logdir` and varies `seed`")
    checked(values, known.values())
    if "backend" not in values:
        raise UserError("no backend: give backend in [options] or in [vary], jax or torch")
    words = [word for name, value in values.items() for word in _words(known[name], value)]
    if bad := next((word for word in words if "\0" in word), None):
        raise UserError(f"{bad!r:.80} has the character 0, which no command line can have")
    options = parse(words)
    name = str(default_logdir(options.task, options.backend, options.seed).name)
    own = {key: value for key, value in varied.items() if key not in IN_NAMES}
    name += "".join(f"-{key}={value}".replace("/", "_").replace(" ", "") for key, value in own.items())
    if len(name.encode()) > LONGEST_NAME:
        raise UserError(
            f"a run would have the name {name:.80}...; expected at most {LONGEST_NAME} bytes: [vary] is part of it"
        )
    command = (*words, "--logdir", str(logdir / name))
    return Item(name, command, dataclasses.replace(options, logdir=logdir / name))


def _words(option: Option, value: Any) -> Iterator[str]:
    """What a command line says for a value of Python."""
    if option.kind is FLAG:
        yield option.flag if value else option.flag.replace("--", "--no-", 1)
    elif option.kind is ENV_ARG:
        for word in keywords.write(value):
            yield from (option.flag, word)
    elif (text := _text(value)).startswith("-"):
        yield f"{option.flag}={text}"  # in a word of its own it would be an option
    else:
        yield from (option.flag, text)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_text, value))
    return str(value).lower() if isinstance(value, bool) else str(value)
