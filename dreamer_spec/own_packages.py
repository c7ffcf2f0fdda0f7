"""Imported before any other of our packages by whatever a user starts: says it in one line if Python finds somebody
else's module under one of their names."""

import conformance

try:
    from conformance.own_names import require_ours
except ImportError as error:
    where = conformance.__file__ or list(conformance.__path__)
    raise ImportError(
        f"{where} hides the package conformance of dreamer-spec, because Python looks there first; rename it, or start "
        f"from another folder"
    ) from error

require_ours()
