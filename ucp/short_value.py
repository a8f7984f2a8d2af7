"""Show a value of untrusted input in an error message, shortened to one line."""

import reprlib

MAX_CHARACTERS = 120


class _ShortRepr(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 2  # a few lines of YAML aliases can stand for gigabytes

    def repr_int(self, x: int, level: int) -> str:
        try:
            return super().repr_int(x, level)
        except ValueError:
            return "a number of thousands of digits"


def shown_key(key: object) -> str:
    """Return a mapping key for an error message. A long key is shortened."""
    return key if isinstance(key, str) and key.isprintable() and len(key) <= MAX_CHARACTERS else shown(key)


def shown(value: object) -> str:
    """Return the `repr` of a value for an error message. A long text is shortened."""
    text = _ShortRepr().repr(value)
    return text if len(text) <= MAX_CHARACTERS else f"{text[: MAX_CHARACTERS - 3]}..."
