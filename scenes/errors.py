"""The one exception a user's mistake ends in."""


class InputError(ValueError):
    """Bad input, in one line that names value, limit and place. The command line prints it and exits with 2."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(str(message).split()))


def require(condition: bool, message: str) -> None:
    """InputError with `message` unless `condition` holds."""
    if not condition:
        raise InputError(message)
