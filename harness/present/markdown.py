"""Words and tables in Markdown, as GitHub reads it."""

from collections.abc import Iterable


def row(fields: Iterable[str]) -> str:
    """Of a table; the fields are Markdown themselves."""
    return f"| {' | '.join(fields)} |"


def escaped(text: str) -> str:
    """As words on one line, whatever they hold."""
    line = " ".join(text.splitlines())
    return "".join(f"\\{character}" if character in "\\`*_{}[]<>#|~&" else character for character in line)
