"""What a program that has ended said last: for an agent that lacks what its mission needs, the reason.

Such an agent ends with status 127 and a sentence on standard error (ucp/contract/CONTRACT.md). A shell, env(1) or the
first
process of a container ends with 127 as well, where it does not find a program: then nobody has said that anything is
not supported, and something is broken.
"""

import re
from pathlib import Path

UNSUPPORTED = 127
LOOKED_AT_BYTES = 4096
CHARACTERS = 300

_OF_A_SHELL = re.compile(
    r"(.+: (line )?\d+: .*(not found|No such file or directory)"  # sh, bash
    r"|\S+: command not found: .*|fish: Unknown command.*"  # zsh, fish
    r"|(\S*/)?env: .*No such file or directory"
    r"|\[FATAL tini .*)"  # the first process of a container
)


def last_words_in(log: Path) -> str:
    """The last line of the file that says something; empty if none does."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - LOOKED_AT_BYTES))
            return last_words(file.read().decode("utf-8", "replace"))
    except OSError:
        return ""


def last_words(text: str) -> str:
    """The last line that says something, as one line for people."""
    lines = ("".join(filter(str.isprintable, line)).strip() for line in reversed(text.splitlines()))
    return next(filter(None, lines), "")[:CHARACTERS]


def of_a_shell(words: str) -> bool:
    """Whether a shell, or what else starts programs, says so that it did not find one."""
    return _OF_A_SHELL.fullmatch(words) is not None
