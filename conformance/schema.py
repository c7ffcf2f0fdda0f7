"""JSON and its schema: what the first thing is that does not fit."""

from collections.abc import Callable, Mapping
from typing import Any

import jsonschema
from jsonschema.exceptions import best_match


def validator(schema: Mapping[str, Any], **kinds: Callable[[Any], bool]) -> Any:
    """Of a JSON Schema 2020-12, in which 1.0 is no integer. kinds: what else it calls a type."""
    known = {"integer": lambda value: type(value) is int, **kinds}
    checks = {name: lambda _, value, holds=holds: holds(value) for name, holds in known.items()}
    types = jsonschema.Draft202012Validator.TYPE_CHECKER.redefine_many(checks)
    return jsonschema.validators.extend(jsonschema.Draft202012Validator, type_checker=types)(schema)


def closed(properties: Mapping[str, Any]) -> dict[str, Any]:
    """The schema of an object with these properties, all of them and no others."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


def misfit(value: Any, expected: Any) -> str:
    """Where a value is not as a `validator` wants it, and what is wrong there; "" if all is well."""
    error = best_match(expected.iter_errors(value))
    if error is None:
        return ""
    return f"{'/'.join(map(str, error.absolute_path)) or 'the whole'}: {error.message:.200}"
