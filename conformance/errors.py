"""The one kind of error that `conformance` answers with a line instead of a traceback."""


class UserError(Exception):
    """Something that the user can mend. The message names the thing and the remedy; the command prints it in one line, exit code 2."""
