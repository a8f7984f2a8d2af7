"""A value that anybody may have written, as an error's sentence shows it: short, on one line, whatever it is."""

import reprlib

MOST_CHARACTERS = 120


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 2  # a few lines of YAML aliases can stand for gigabytes

    def repr_int(self, x: int, level: int) -> str:
        try:
            return super().repr_int(x, level)
        except ValueError:
            return "a number of thousands of digits"


def shown_key(key: object) -> str:
    """A key of a mapping, as it stands there; or its beginning."""
    return key if isinstance(key, str) and key.isprintable() and len(key) <= MOST_CHARACTERS else shown(key)


def shown(value: object) -> str:
    """The value as Python writes it, or its beginning."""
    text = _Short().repr(value)
    return text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."
