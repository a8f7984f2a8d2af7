"""An implementation of the 20 handlers, in a form that can be compared with records: an agent core and its tables of
handlers.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from harness.checker.reference.algorithms import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER, tally_of
from harness.checker.reference.state import ReferenceState
from harness.checker.steps._adopting_core import AdoptingCore
from harness.checker.steps.trace_header import CheckedHeader


class ReferenceCore(AdoptingCore, ReferenceState):
    """The reference implementation, extended so that it can continue from the state that an agent recorded."""


class CoreImplementation(NamedTuple):
    """An agent core and its handlers. The tables find a handler by message type, by timer, by local event or by its
    name.
    """

    core: Callable[[CheckedHeader], AdoptingCore]
    on_message: Mapping[Any, Any]
    on_timer: Mapping[str, Any]
    on_local_event: Mapping[Any, Any]
    handlers: Mapping[str, Any]
    tally_of: Callable[[Any, Any], Any]


def _reference_core(header: CheckedHeader) -> AdoptingCore:
    return ReferenceCore(header.agent_id, header.initial_data, header.settings)


REFERENCE = CoreImplementation(_reference_core, ON_MESSAGE, ON_TIMER, ON_LOCAL_EVENT, HANDLERS, tally_of)
"""The reference implementation. The checker judges agents by it."""
