"""Draw a diagram of the event handlers from their declarations, and write ../../ucp/contract/HANDLERS.md.

Run it with `python -m docs.generate.handlers`.

Chapter 3 of the thesis has one figure for each of the 20 handlers (Figures 3.4-3.23, symbols in Figure 3.3) and an
outline (Figure 3.2). This diagram in Mermaid combines these figures. Arrows lead from each handler to the handlers that
it causes.
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
# The 20 event handlers

An event handler is the code that an agent runs for one kind of event. Chapter 3 of the thesis defines 20 handlers,
Algorithms 1-20. They are in [commit.py](../commit.py) and [reconcile.py](../reconcile.py). The page ["The agent
contract"](CONTRACT.md#the-20-algorithms) lists the handlers in pseudo-code. The page [BRANCHES.md](BRANCHES.md) lists
the branches of each handler with their conditions. The page ["How UCP works"](../../docs/explanation/protocol.md)
explains the protocol.

Each handler declares the messages that it sends, the timers that it starts, and the local events that it triggers.
[core.py](../core.py) rejects any message, timer or local event that the handler does not declare. The tables in
[agent.py](../agent.py) define which handler runs when a message arrives, a timer expires, or a local event occurs.
`python -m docs.generate.handlers` generates this page from these declarations and tables.

The diagram has three kinds of arrows. Each arrow leads from a handler to a second handler. The first handler causes the
second handler to run:

| arrow | cause | where and when the second handler runs |
|---|---|---|
| thick | local event | in the same agent, directly after the current handlers |
| thin | timer | in the same agent, when the timer expires |
| dotted | message | in each agent that receives the message |

Two causes are not in the diagram. The operator can trigger the handler "Reconcile Begin" with a command. An agent that
continues from its store starts with the handler "Reconcile Finalize".

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
    """Yield the causes of a run of the handler, such as the handlers that trigger it."""
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
