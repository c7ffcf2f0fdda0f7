"""The one kind of error that `train` answers with a line instead of a traceback."""


class UserError(Exception):
    """Something that the user can mend. The message names the thing and the remedy; `train` prints it in one line and exits with code 2."""
