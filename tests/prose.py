"""Count language patterns that make docs, docstrings and comments hard to read, and record the counts.

The house style asks for short sentences with an actor, a verb and an object. Each pattern here is a habit that breaks
this rule. `tests/test_prose.py` compares the count of each file with `tests/prose_counts.txt`: a count may only go
down. A file that is not listed must contain no pattern. A low count does not make a text readable; a reader does.

`python -m tests.prose` prints each occurrence, and `python -m tests.prose FILE ...` prints the occurrences in these
files. `python -m tests.prose --record` lowers the recorded counts, and never raises one.
"""

import ast
import functools
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).parents[1]
COUNTS = Path(__file__).with_name("prose_counts.txt")
PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
FOLDERS = ("benchmarks", "docs", "harness", "netem", "scenarios", "sitl", "tests", "ucp")
SUFFIXES = (".py", ".md", ".yaml")

PATTERNS = {
    "who for a program or value": re.compile(
        r"\b[Ww]ho(?:m)?ever\b|(?<![,\w] )\bWho\b|\b(?:of|by|to|for|with|from|as|than|and|or) (?:who|whom)\b"
    ),
    "nobody, somebody": re.compile(r"\b(?:[Nn]obody|[Aa]nybody|[Ss]omebody|[Ee]verybody)\b"),
    "tell": re.compile(r"\b(?:[Tt]old|[Tt]ells?)\b"),
    "clause in place of a noun": re.compile(
        r"\b(?:all that|[Ww]hat (?:is|was|were|came|comes|it|they|has|had|follows|an?|the|others|there))\b"
    ),
    "so many, so often": re.compile(r"\b[Ss]o (?:many|often|long|much|few)\b(?! (?:that|as))"),
}
INVERTED = re.compile(
    r"(?:Of|What|Who|Whose|Whom|That|So|As|By|In|From|For|To|With|At|Until|Since|Beside|Besides|And|Or|Nor|Whether) "
)
"""Matches the first word of a docstring that starts with neither a verb nor a noun phrase."""
INVERTED_PARAGRAPH = re.compile(r"(?:Of|What|Who|Whose|Whom|That|So|By|From|Until|Beside|Besides|And|Or|Nor|Whether) ")
"""Matches the first word of such a heading or paragraph of a page. "In virtual time, ..." and "For example, ..." are
allowed.
"""

EXCEPTIONS = {
    "tests/prose.py": "It holds the patterns.",
    "tests/test_prose.py": "It tests the patterns.",
}
"""Files whose patterns do not count, each with the reason."""


class Occurrence(NamedTuple):
    """A pattern in a text, with the surrounding words."""

    pattern: str
    excerpt: str


def files() -> list[str]:
    """Return the paths of all texts in which patterns are counted, relative to the root of the repository."""
    found = [REPOSITORY / name for name in PAGES]
    for folder in FOLDERS:
        found += (path for path in (REPOSITORY / folder).rglob("*") if path.suffix in SUFFIXES)
    names = (path.relative_to(REPOSITORY).as_posix() for path in found)
    return sorted(name for name in names if not name.startswith("tests/corpus/"))


def occurrences(path: Path) -> Iterator[Occurrence]:
    """Yield each pattern in the docstrings and comments of a module, or in the text of a page."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        docstrings = list(_docstrings(source))
        texts, starts, inverted = [*docstrings, *_comments(source)], docstrings, INVERTED
    else:
        plain = re.sub(r"^```.*?^```", "", source, flags=re.DOTALL | re.MULTILINE)
        plain = re.sub(r"^(?: {4}|\t).*$", "", plain, flags=re.MULTILINE) if path.suffix == ".md" else plain
        texts, starts, inverted = [plain], _paragraphs(plain) if path.suffix == ".md" else [], INVERTED_PARAGRAPH
    for text in texts:
        prose = re.sub(r"`[^`]*`", "``", text)
        for name, pattern in PATTERNS.items():
            for match in pattern.finditer(prose):
                around = prose[max(0, match.start() - 30) : match.end() + 30]
                yield Occurrence(name, " ".join(around.split()))
    for text in starts:
        if inverted.match(text.lstrip()):
            yield Occurrence("inverted start", " ".join(text.split())[:60])


def _docstrings(source: str) -> Iterator[str]:
    """Yield the docstrings of a module, including those below attributes and constants."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for item in body if isinstance(body, list) else []:
            if (
                isinstance(item, ast.Expr)
                and isinstance(item.value, ast.Constant)
                and isinstance(item.value.value, str)
            ):
                yield item.value.value


def _comments(source: str) -> Iterator[str]:
    """Yield the comments of a module."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string.lstrip("#: ")


def _paragraphs(page: str) -> list[str]:
    """Return the headings and paragraphs of a Markdown page, without lists and tables."""
    blocks = re.split(r"\n\s*\n|(?<=\n)(?=#)", page)
    return [block.strip().lstrip("# *") for block in blocks if not block.strip().startswith(("-", "|", "1.", "* "))]


@functools.cache
def counted() -> dict[str, int]:
    """Return the number of occurrences in each file that has any."""
    counts = {name: sum(1 for _ in occurrences(REPOSITORY / name)) for name in files() if name not in EXCEPTIONS}
    return {name: count for name, count in counts.items() if count}


def recorded() -> dict[str, int]:
    """Return the recorded number of occurrences by file."""
    rows = (line.split(maxsplit=1) for line in COUNTS.read_text(encoding="utf-8").splitlines())
    return {name: int(count) for count, name in rows}


def record(counts: dict[str, int]) -> None:
    """Write the counts, with one file in each line."""
    COUNTS.write_text("".join(f"{count:4} {name}\n" for name, count in sorted(counts.items())), encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Print occurrences, or lower the recorded counts."""
    if arguments == ["--record"]:
        before = recorded()
        now = counted()
        record({name: min(count, before.get(name, 0)) for name, count in now.items() if before.get(name, 0)})
        return
    for name in arguments or files():
        for pattern, excerpt in occurrences(REPOSITORY / name) if name not in EXCEPTIONS else []:
            print(f"{name}: {pattern}: ... {excerpt} ...")  # noqa: T201  (a command)


if __name__ == "__main__":
    main(sys.argv[1:])
