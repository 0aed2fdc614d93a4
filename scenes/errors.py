"""The one exception a user's mistake ends in."""


class InputError(ValueError):
    """Bad input, in one line that names value, limit and place. The command line prints it and exits with 2."""

    def __init__(self, message: str) -> None:
        # a file's name may hold bytes that are no text: what is printed must be
        text = str(message).encode("utf-8", "backslashreplace").decode()
        super().__init__(" ".join(text.split()))


def require(condition: bool, message: str) -> None:
    """InputError with `message` unless `condition` holds."""
    if not condition:
        raise InputError(message)
