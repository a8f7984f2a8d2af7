"""Test that handlers follow their declarations, and that the diagram shows these declarations."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

import ucp
from docs.generate.handlers import PAGE, page
from harness.archive.traces import Trace
from harness.run.simulate import simulate
from tests.harness.virtual import scenario
from ucp.agent import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER, Agent
from ucp.core import Core
from ucp.handler import EventHandler, LocalEvent
from ucp.messages import Message, RequestForBlock
from ucp.settings import Settings
from ucp.state import AgentState
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger

OF_MESSAGE = {message.NAME: handler.name for message, handler in ON_MESSAGE.items()}
OF_TIMER = {timer: handler.name for timer, handler in ON_TIMER.items()}
OF_LOCAL_EVENT = {event: handler.name for event, handler in ON_LOCAL_EVENT.items()}

PARTITION = [{"at_s": 200, "partition": [[1, 2], [3, 4, 5]]}, {"at_s": 500, "heal": True}]
RESTARTS = [
    {"at_s": 150, "reboot": [2], "down_s": 30, "disk": "kept"},
    {"at_s": 200, "kill": [3]},
    {"at_s": 400, "restart": [3]},
    {"at_s": 450, "pause": [4]},
    {"at_s": 500, "resume": [4]},
]
RUNS = {
    "loss": {"network": {"loss": 0.25}, "final_reconcile": True},
    "partition": {"timeline": PARTITION, "final_reconcile": True},
    "restarts": {"timeline": RESTARTS, "network": {"loss": 0.1}},
    "readings": {"network": {"loss": 0.25}, "settings": {"phase1_tie": "pop", "phase2_tie": "block"}},
    "asking": {"network": {"loss": 0.25}, "settings": {"asks_after_commit": True}},
}
HELD_ALREADY = ("reconcile_phase_3", "Reconcile Finalize")
"""An action that a handler takes only if the block after the mutual block is already in the agent's chain.

Correct agents never reach this state.
"""


def traces(**keys: Any) -> Iterator[Trace]:
    played = scenario(agents=5, duration_s=900, **keys)
    for seed in (1, 2):
        simulated = simulate(played, seed, tracing=True)
        yield from simulated.evidence.traces.values()


def done(trace: Trace, handlers: dict[str, EventHandler[Any]]) -> Iterator[tuple[str, str]]:
    """Yield each action of each handler in a trace, as a pair of the handler and the action. Fail if the handler does
    not declare the action.

    An action is the name of a sent message, of a started timer or of a triggered event.
    """
    for life in trace.incarnations():
        ran: set[str] = set()
        for number, run in life:
            where = f"line {number}: {run.handler}"
            declared = handlers[run.handler]
            assert run.algorithm == declared.algorithm, where
            assert run.branch in declared.branches, where
            for sent in run.sent:
                assert sent.message in {message.NAME for message in declared.sends}, where
                yield run.handler, sent.message
            match run.trigger:
                case MessageTrigger(message):
                    assert OF_MESSAGE[message] == run.handler, where
                case TimerTrigger(timer):
                    assert OF_TIMER[timer] == run.handler, where
                    starters = {name for name, handler in HANDLERS.items() if timer in handler.starts}
                    assert starters & ran, where
                    yield from ((starter, timer) for starter in starters & ran)
                case LocalTrigger(by):
                    (event,) = (event for event, name in OF_LOCAL_EVENT.items() if name == run.handler)
                    assert event in handlers[by].triggers, where
                    assert by in ran, where
                    yield by, event
                case EventTrigger():
                    assert run.handler == OF_LOCAL_EVENT["Build Data Block"], where
                case OperatorTrigger():
                    assert run.handler == OF_LOCAL_EVENT["Reconcile Begin"], where
                case BootTrigger():
                    assert run.handler == OF_LOCAL_EVENT["Reconcile Finalize"], where
                case other:
                    pytest.fail(f"{where} has the trigger {other}")
            ran.add(run.handler)


def test_trace_lines_match_the_declarations_of_all_handlers() -> None:
    seen = {deed for keys in RUNS.values() for trace in traces(**keys) for deed in done(trace, HANDLERS)}
    declared = {
        (handler.name, what)
        for handler in HANDLERS.values()
        for what in (*(message.NAME for message in handler.sends), *handler.starts, *handler.triggers)
    }
    assert seen == declared - {HELD_ALREADY}


def test_undeclared_action_of_a_handler_raises_an_error() -> None:
    core = Core(1, b"", Settings())
    core.running = HANDLERS["build_data_block"]
    with pytest.raises(AssertionError, match="build_data_block does not declare that it sends Request for Block"):
        core.send(RequestForBlock(bytes(32)))
    with pytest.raises(AssertionError, match="build_data_block does not declare that it starts voting"):
        core.start(core.voting_timer, 1.0)
    with pytest.raises(AssertionError, match="build_data_block does not declare that it triggers Reconcile Begin"):
        core.trigger("Reconcile Begin")
    assert not core.outbox and not core.triggered and not core.voting_timer.active


def test_each_algorithm_has_one_handler_in_one_table() -> None:
    """Only the handler of Algorithm 20 is in two tables. The timer for the pause between two commits (Section 4.2) also
    calls it.
    """
    assert [handler.algorithm for handler in HANDLERS.values()] == list(range(1, 21))
    tabled = [handler.name for table in (ON_MESSAGE, ON_TIMER, ON_LOCAL_EVENT) for handler in table.values()]
    assert sorted(tabled) == sorted([*HANDLERS, "reconcile_finalize"])


@pytest.mark.parametrize(
    ("event", "by"),
    [
        ("Process Next Deque Block", {1, 5, 20}),  # Section 3.6.2, before Algorithm 2
        ("Reconcile Begin", {5, 13}),  # Figure 3.10
        ("Reconcile Phase 1", {7, 11}),  # Figure 3.11
        ("Reconcile Phase 2", {11, 16, 18}),  # Figure 3.15, and step 4 of Reconcile Phase 3 (Section 3.5.3)
        ("Reconcile Phase 3", {15}),  # Figure 3.19
        ("Reconcile Finalize", {11, 15, 16, 19}),  # Figure 3.23; 16 if the agent already holds the block
    ],
)
def test_handlers_trigger_the_local_events_of_the_thesis(event: LocalEvent, by: set[int]) -> None:
    assert {handler.algorithm for handler in HANDLERS.values() if event in handler.triggers} == by


def test_each_message_and_timer_has_a_handler_and_a_source() -> None:
    sent: set[type[Message]] = {message for handler in HANDLERS.values() for message in handler.sends}
    assert sent == set(ON_MESSAGE)
    assert {timer for handler in HANDLERS.values() for timer in handler.starts} == set(ON_TIMER)


def test_diagram_shows_the_existing_handlers() -> None:
    assert PAGE.read_text() == page(), "write it again: python -m docs.generate.handlers"


def test_driver_interface_offers_no_operation_on_the_state() -> None:
    offered = {name for face in (Agent, AgentState) for name in dir(face)}
    verbs = {name for name in vars(Core) if not name.startswith("_")}
    assert {"commit", "pop_to_stack", "send", "trigger"} <= verbs
    assert not verbs & offered


def test_no_module_of_ucp_imports_in_a_circle() -> None:
    """Imports for type checking count too. The CycleError of `graphlib` names the circle."""
    folder = Path(ucp.__path__[0])
    modules = {path.stem: imported(path) for path in folder.glob("*.py")}
    order = list(TopologicalSorter(modules).static_order())
    assert order.index("handler") < order.index("state") < order.index("core") < order.index("commit")
    assert "agent" not in modules["commit"] | modules["reconcile"] | modules["store"]


def imported(path: Path) -> set[str]:
    """Return the modules of the package `ucp` that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "ucp":
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ucp."):
            names.add((node.module or "").split(".")[1])
    return names
