"""Generate the sections of `docs/reference/commands.md` from the help texts of the commands.

The page shows the description, usage, arguments and options of each command, so it cannot differ from `--help`.
"""

import re
from collections.abc import Iterator
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

from harness.cli import COMMANDS, load_command

MARK = "<!-- commands -->"
PROGRAM = "ucp-harness"
GROUPS = {
    "run": "Play scenarios",
    "look": "Examine runs",
    "field": "Prepare missions and evaluate records",
    "many": "Play many runs",
    "prove": "Prove properties and test agents",
    "this machine": "Set up the machine",
}
"""The heading on the page for each panel of `ucp-harness --help`."""


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    return markdown.replace(MARK, reference()) if MARK in markdown else markdown


def reference() -> str:
    """Return a section for each group of commands."""
    parts: list[str] = []
    for panel in dict.fromkeys(command.panel for command in COMMANDS.values()):
        parts.append(f"## {GROUPS[panel]}")
        for name, command in COMMANDS.items():
            if command.panel == panel:
                parts += _section(name, command.summary)
    return "\n\n".join(parts)


def _section(name: str, summary: str) -> Iterator[str]:
    """Yield the paragraphs about one command, or about a group of commands."""
    command = load_command(name)
    yield f"### {PROGRAM} {name}"
    if not hasattr(command, "commands"):
        yield from _command(f"{PROGRAM} {name}", command)
        return
    yield summary
    for inner, part in command.commands.items():
        yield f"#### {PROGRAM} {name} {inner}"
        yield from _command(f"{PROGRAM} {name} {inner}", part)


def _command(call: str, command: Any) -> Iterator[str]:
    context = command.make_context(call, [], resilient_parsing=True)
    parameters = [parameter for parameter in command.get_params(context) if not parameter.hidden]
    arguments = [parameter for parameter in parameters if parameter.param_type_name == "argument"]
    options = [parameter for parameter in parameters if parameter.param_type_name != "argument"]
    yield _text(command.help or "")
    yield "```text\n" + " ".join([call, "[OPTIONS]", *map(_place, arguments)]) + "\n```"
    if arguments:
        rows = [_row(_place(argument), argument.help) for argument in arguments]
        yield "\n".join(["| argument | description |", "|---|---|", *rows])
    rows = [_row(_names(option, context), _described(option, context)) for option in options]
    yield "\n".join(["| option | description |", "|---|---|", *rows])


def _place(argument: Any) -> str:
    """Return the argument in the form in which the usage line shows it."""
    name = argument.metavar or argument.name.upper()
    if not argument.required and not name.startswith("["):
        name = f"[{name}]"
    return name if argument.nargs != -1 or "..." in name else f"{name}..."


def _names(option: Any, context: Any) -> str:
    """Return the names of the option, and the type of its value."""
    names, _ = option.get_help_record(context)
    return str(names)


def _described(option: Any, context: Any) -> str:
    """Return the help text of an option, with its default and its allowed range."""
    _, text = option.get_help_record(context)
    panel = option.rich_help_panel
    return f"{panel}: {text}" if panel and panel.startswith("With") else str(text)


def _row(names: str, text: str) -> str:
    """Return a row of a table. Pipes are escaped, because they separate cells."""
    code, words = (" ".join(cell.replace("|", "\\|").split()) for cell in (names, text or ""))
    return f"| `{code}` | {_text(words)} |"


def _text(text: str) -> str:
    """Return the help as Markdown: option names become code, and the words "Exit status" become bold."""
    text = text.replace("<", "&lt;")
    text = re.sub(r"(?<![`\w-])(--[a-z][a-z-]*)(?![^`]*`(?:[^`]*`[^`]*`)*[^`]*$)", r"`\1`", text)
    return re.sub(r"Exit status 0:", "**Exit status** 0:", text)
