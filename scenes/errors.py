"""The one exception a user's mistake ends in."""


class InputError(ValueError):
    """Bad input, in one line that names value, limit and place. The command line prints it and exits with 2."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(printable(str(message)).split()))


def printable(text: str) -> str:
    """Return text that UTF-8 can hold: bytes of a file's name that are no text become escapes."""
    return text.encode("utf-8", "backslashreplace").decode()


def require(condition: bool, message: str) -> None:
    """InputError with `message` unless `condition` holds."""
    if not condition:
        raise InputError(message)
