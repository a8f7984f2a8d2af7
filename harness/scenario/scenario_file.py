"""Write a scenario as a readable file: a comment at the top, and one line for each event or change."""

from collections.abc import Callable, Iterable, Iterator
from textwrap import wrap
from typing import Any

import yaml

ORDER = (
    "name",
    "agents",
    "agent_command",
    "duration_s",
    "initial_data",
    "network",
    "clocks",
    "settings",
    "stagger",
    "quirks",
    "expect",
    "timeline",
    "schedule",
    "events",
    "fates",
    "datagrams",
    "lateness",
    "settle",
    "final_reconcile",
)
"""Order of the keys in the file. Keys that are not listed follow at the end."""
WIDTH = 112

Document = dict[str, Any]


def to_yaml(
    document: Document, comment: Iterable[str], remark: Callable[[Document], str | None] = lambda entry: None
) -> str:
    """Return the scenario as YAML text. `remark` returns a comment for an entry of a list, or None."""
    lines = [f"# {line}".rstrip() for line in comment]
    for key in sorted(document, key=lambda key: ORDER.index(key) if key in ORDER else len(ORDER)):
        lines += _lines(key, _plain(document[key]), remark)
    return "\n".join(lines) + "\n"


def _lines(key: str, value: Any, remark: Callable[[Document], str | None]) -> Iterator[str]:
    """Yield one line for a key, or one line for each entry of a list of mappings."""
    if key == "events" and "script" in value:
        yield "events:"
        yield f"  source: {value['source']}"
        yield "  script:"
        yield from (f"    - {in_one_line(event)}" for event in value["script"])
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        yield f"{key}:"
        for entry in value:
            comment = remark(entry)
            yield from _entry(entry, f"  # {comment}" if comment else "")
    elif isinstance(value, dict) and any(map(_is_long, value.values())):
        yield f"{key}:"
        for name, item in value.items():
            yield from _item(f"  {in_one_line(name)}", item)
    else:
        yield f"{key}: {in_one_line(value)}"


def _entry(entry: Document, comment: str) -> Iterator[str]:
    """Yield an entry of a list as one line, or as several lines if it contains a long text."""
    if not any(map(_is_long, entry.values())):
        yield f"  - {in_one_line(entry)}{comment}"
        return
    begin = "  - "
    for name, item in entry.items():
        yield from _item(begin + name, item)
        begin = "    "


def _item(key: str, value: Any) -> Iterator[str]:
    """Yield a key with its value. A long text takes several lines, in YAML's folded style."""
    if not _is_long(value) or " " not in value:
        yield f"{key}: {in_one_line(value)}"
        return
    yield f"{key}: >-"
    indent = " " * (len(key) - len(key.lstrip(" -")) + 2)
    yield from wrap(value, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False)


def _is_long(value: Any) -> bool:
    return isinstance(value, str) and len(value) > WIDTH // 2


def in_one_line(value: Any) -> str:
    """Return the value as YAML on a single line."""
    written: str = yaml.safe_dump([value], default_flow_style=True, sort_keys=False, width=1e9, allow_unicode=True)
    return written.strip()[1:-1]


def _plain(value: Any) -> Any:
    """Return the value with decimal numbers such as 5.0 as integers. Agent IDs that are keys also become integers."""
    if isinstance(value, dict):
        named = ((int(key) if isinstance(key, str) and key.isdecimal() else key, item) for key, item in value.items())
        return {key: _plain(item) for key, item in named}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
