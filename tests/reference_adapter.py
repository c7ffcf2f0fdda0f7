"""The reference as a file for the server, with the namespaces of the protocol made into the objects of the
specification again."""

import dataclasses

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.interface import INTERFACE, OBJECTS
from spec import Config, Discrete, Image, Parameter, Spaces, Vector

REFERENCE = NumpyAdapter()
KINDS = {kind.__name__.lower(): kind for kind in (Config, Discrete, Image, Parameter, Spaces, Vector)}


def restored(value):
    if isinstance(value, dict):
        return {key: restored(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return tuple(map(restored, value))
    kind = KINDS.get(getattr(value, "kind", None))
    return (
        kind(**{field.name: restored(getattr(value, field.name)) for field in dataclasses.fields(kind)})
        if kind
        else value
    )


def offered(name):
    return lambda *arguments: getattr(REFERENCE, name)(*map(restored, arguments))


globals().update({name: offered(name) for name in INTERFACE if name not in OBJECTS and hasattr(REFERENCE, name)})
