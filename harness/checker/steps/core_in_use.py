"""Make the installed agent core `ucp.agent` comparable with the records of an agent.

The verdict on agents comes from the reference. The installed core repeats the recorded steps for two other purposes: a
debugger can stop in the handlers of `ucp`, and `bisect` can compare the cores of two commits.
"""

from dataclasses import asdict

from harness.checker.steps._adopting_core import AdoptingCore
from harness.checker.steps.implementation import CoreImplementation
from harness.checker.steps.trace_header import CheckedHeader
from ucp.agent import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER, tally_of
from ucp.block import Block
from ucp.core import Core
from ucp.messages import Message
from ucp.settings import Settings


class _CoreInUse(AdoptingCore, Core):  # type: ignore[misc]  # a core has the attributes of the reference's state
    @property
    def sequence(self) -> int:
        return self._sequence

    @sequence.setter
    def sequence(self, sequence: int) -> None:
        self._sequence = sequence

    def note_held(self) -> None:
        self._held_aside = {block.block_hash for block in (*self.blocks_to_be_committed, *self.reconcile_stack)}

    def send(self, message: Message) -> None:
        self.outbox.append((self.sequence, message))
        self.sequence += 1

    def _changed(self, operation: str, block: Block) -> None:
        self.changed(operation, block)


def settings_in_use(header: CheckedHeader) -> Settings:
    """Convert the settings in a trace to the settings class of the installed core."""
    return Settings(**asdict(header.settings))


def _core(header: CheckedHeader) -> AdoptingCore:
    return _CoreInUse(header.agent_id, header.initial_data, settings_in_use(header))


IN_USE = CoreImplementation(_core, ON_MESSAGE, ON_TIMER, ON_LOCAL_EVENT, HANDLERS, tally_of)
"""The agent core `ucp.agent` of this installation."""
