"""The thesis's event diagram, drawn from what the handlers declare: `python -m docs.generate.handlers` writes
../../ucp/contract/HANDLERS.md.

Chapter 3 has a figure for each of the 20 event handlers (Figures 3.4-3.23, symbols in Figure 3.3) and one of their
outline (Figure 3.2). This is all of them as one, in Mermaid: from whatever happens to the handlers that run then.
"""

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from ucp import commit, reconcile
from ucp.agent import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER
from ucp.handler import EventHandler

PAGE = Path(__file__).parents[2] / "ucp" / "contract" / "HANDLERS.md"

INTRODUCTION = """\
# The event handlers, and how one leads to another

The 20 event handlers of Chapter 3, Algorithms 1-20, are in [commit.py](../commit.py) and
[reconcile.py](../reconcile.py).
Each declares what it may send, which timers it may start and which local events it may trigger; [core.py](../core.py)
holds it to that. The tables in [agent.py](../agent.py) say which handler runs when a message arrives, a timer expires
or a local event happens. This page is written from both by `python -m docs.generate.handlers`;
[BRANCHES.md](BRANCHES.md) says when a handler takes which of its branches.

A thick arrow is a local event, which the same agent handles next; a thin one a timer, which the same agent handles when
it expires; a dotted one a message, which every agent handles that receives it. Besides, the operator can trigger
Reconcile Begin, and an agent that boots from its store begins with Reconcile Finalize.

"""

TABLE = """
| Algorithm | runs when | sends | starts | triggers |
|---|---|---|---|---|
"""


def page() -> str:
    chart = "\n".join(["flowchart TD", *(f"    {line}" for line in (*_nodes(), *_arrows()))])
    return f"{INTRODUCTION}```mermaid\n{chart}\n```\n{TABLE}{''.join(map(_row, HANDLERS.values()))}"


def _nodes() -> Iterator[str]:
    yield 'vehicle(["the vehicle logs an event"])'
    yield from _group("Generate and commit blocks", commit)
    yield from _group("Reconcile", reconcile)


def _group(name: str, module: ModuleType) -> Iterator[str]:
    yield f'subgraph {module.__name__.replace(".", "_")} ["{name}"]'
    for handler in HANDLERS.values():
        if handler.run.__module__ == module.__name__:
            yield f'    {_node(handler)}["{handler.title}"]'
    yield "end"


def _arrows() -> Iterator[str]:
    yield f"vehicle ==> {_node(ON_LOCAL_EVENT['Build Data Block'])}"
    for handler in HANDLERS.values():
        for event in handler.triggers:
            yield f"{_node(handler)} ==> {_node(ON_LOCAL_EVENT[event])}"
        for timer in handler.starts:
            yield f"{_node(handler)} -->|{timer} timer| {_node(ON_TIMER[timer])}"
        for message in handler.sends:
            yield f"{_node(handler)} -.->|{message.NAME}| {_node(ON_MESSAGE[message])}"


def _node(handler: EventHandler[Any]) -> str:
    return f"algorithm_{handler.algorithm}"


def _row(handler: EventHandler[Any]) -> str:
    cells = (
        handler.title,
        _list(_causes(handler)),
        _list(message.NAME for message in handler.sends),
        _list(f"{timer} timer" for timer in handler.starts),
        _list(handler.triggers),
    )
    return f"| {' | '.join(cells)} |\n"


def _causes(handler: EventHandler[Any]) -> Iterator[str]:
    """What of the three tables makes it run, and from where."""
    for message, receiver in ON_MESSAGE.items():
        if receiver is handler:
            yield f"{message.NAME} arrives"
    for timer, expiration in ON_TIMER.items():
        if expiration is handler:
            yield f"{timer} timer expires"
    for event, local in ON_LOCAL_EVENT.items():
        if local is handler:
            by = [str(cause.algorithm) for cause in HANDLERS.values() if event in cause.triggers]
            yield f"triggered by {', '.join(by)}" if by else "the vehicle logs an event"


def _list(parts: Iterator[str] | tuple[str, ...]) -> str:
    return "<br>".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page())
