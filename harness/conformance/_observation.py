"""Compare one step of the agent under test with the same step of the reference. Describe the result in words."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harness.conformance._alphabet import AgentInput
from harness.conformance._reference_model import AGENT, ExpectedOutcome, ExpectedRun, ReferenceModel, TimerExpiry
from harness.conformance._state_space import AgentState, VectorKey, key_of, next_timer_name
from harness.report.stories.story_names import INCEPTION, in_words
from ucp.block import next_chain_hash
from ucp.messages import MalformedDatagramError, Message, decode


class KnownNames:
    """The names, such as "2.1", of the blocks and chains that the reference knows."""

    def __init__(self, model: ReferenceModel) -> None:
        state = model.state
        blocks = [*model.blocks.values(), *state.chain, *state.blocks_to_be_committed, *state.reconcile_stack]
        self._blocks: dict[str, str] = {}
        count: dict[int, int] = {}
        for block in {block.block_hash: block for block in blocks}.values():
            count[block.agent_id] = count.get(block.agent_id, 0) + 1
            self._blocks[block.block_hash.hex()] = f"{block.agent_id}.{count[block.agent_id]}"
        chain_hash, text = state.chain.inception.chain_hash, ""
        self._chains = {chain_hash: INCEPTION}
        self._below: dict[bytes, str] = {}
        for block in (*state.chain, *reversed(state.reconcile_stack)):
            chain_below, chain_hash = self._chains[chain_hash], next_chain_hash(chain_hash, block.block_hash)
            text = f"{text} {self.block(block.block_hash.hex())}".strip()
            self._chains[chain_hash], self._below[chain_hash] = text, chain_below
        for waiting in blocks:
            chain_hash = next_chain_hash(state.chain.top_chain_hash, waiting.block_hash)
            top = self._chains[state.chain.top_chain_hash]
            name = self.block(waiting.block_hash.hex())
            self._chains.setdefault(chain_hash, name if top == INCEPTION else f"{top} {name}")
            self._below.setdefault(chain_hash, top)

    def block(self, block_hash: str) -> str:
        return self._blocks.get(block_hash, "an unknown block")

    def chain(self, chain_hash: bytes) -> str:
        return self._chains.get(chain_hash, "an unknown chain")

    def chain_below(self, chain_hash: bytes) -> str:
        return self._below.get(chain_hash, "an unknown chain")


def message_text(message: Message, names: KnownNames) -> str:
    """Describe a message, such as "Commit Block (1.1 on inception)"."""
    return in_words(message, names)


def datagram_text(data: bytes, names: KnownNames) -> str:
    try:
        return message_text(decode(data).message, names)
    except MalformedDatagramError as error:
        return f"{len(data)} bytes that are an invalid message ({error.reason}): {data[:24].hex()}"


COMPARED = ("idle", "reconcile_in_progress", "chain", "deque", "stack", "completed", "reconciles", "top_chain_hash")
"""Keys of the status that are compared. A key that the agent's status lacks is not compared."""
SHOWN = 12
MAX_EARLY_TIMERS = 3
"""Maximum number of timers that the comparison lets expire early, one after another, to explain a message that came too
early.
"""


@dataclass(frozen=True)
class RecordedDatagram:
    """A datagram between the agent under test and the simulated other agents."""

    t: float
    """Mission second at which the datagram was sent or received."""
    sent: bool
    """True if the agent under test sent the datagram. False if a peer sent it."""
    data: bytes
    text: str
    """Description of the message."""


@dataclass(frozen=True)
class TestedStep:
    """One step of the agent under test."""

    key: VectorKey
    outcome: ExpectedOutcome
    given: str
    """Description of the input."""
    expected: tuple[str, ...]
    """Descriptions of the messages that the reference sent."""
    received: tuple[str, ...]
    """Descriptions of the messages that the agent sent."""
    wrong: tuple[str, ...]
    """A sentence for each deviation. Empty if the agent behaved like the reference."""
    before: AgentState
    late: bool = False
    """True if the machine was late, so that the step proves nothing."""
    unexpected: tuple[str, ...] = ()
    """Names of messages that the agent sent but the reference did not."""
    missing: tuple[str, ...] = ()
    wrong_status_keys: tuple[str, ...] = ()
    """Keys of the status with wrong values."""
    wrong_timer: str | None = None
    """Name of a timer that expired or will expire at a wrong time. None if there is no such timer."""
    running_timer: str | None = None
    """Name of the next timer to expire, if its expiry time is correct. None over UDP."""
    ended: str | None = None
    """A phrase about the end or the hanging of the agent. None if the agent still runs."""
    hidden_run: ExpectedRun | None = None
    """An earlier handler run that may be the true cause of the failure. It handled an answer that the agent must
    ignore, or it should have stopped a timer. None if no such run is known.
    """


def compare(
    model: ReferenceModel,
    given: AgentInput,
    before: AgentState,
    outcome: ExpectedOutcome,
    datagrams: Iterable[bytes],
    status: Mapping[str, Any],
    wrong: Iterable[str],
) -> TestedStep:
    """Compare the agent's datagrams and status after an input with those of the reference after the same input.

    `wrong` contains sentences about known deviations.
    """
    sentences, names, received = list(wrong), KnownNames(model), list[Message]()
    for data in datagrams:
        try:
            sender, _, message = decode(data)
        except MalformedDatagramError:
            sentences.append(f"it sent {datagram_text(data, names)}")
            continue
        if sender != AGENT:
            sentences.append(f"it sent a message as agent {sender}")
        received.append(message)
    missing = [message for message in outcome.sent if message not in received]
    unexpected = [message for message in received if message not in outcome.sent]
    if received != outcome.sent:
        sentences += [f"it did not send {message_text(message, names)}" for message in missing]
        sentences += [f"it sent {message_text(message, names)}" for message in unexpected[:SHOWN]]
        if not missing and not unexpected:
            sentences.append("it sent its messages in another order, or sent one of them twice")
    expected_status = model.status()
    wrong_status_keys = tuple(key for key in COMPARED if key in status and status[key] != expected_status[key])
    sentences += [f"its status says {key} {status[key]!r}, not {expected_status[key]!r}" for key in wrong_status_keys]
    wrong_timer = _timer_expired_early(model, outcome.sent, received, status) if sentences else None
    if wrong_timer is not None:
        sentences.append(f"its timer {wrong_timer} seems to have expired already")
    return TestedStep(
        key_of(before, given),
        outcome,
        given.name,
        tuple(message_text(message, names) for message in outcome.sent),
        tuple(message_text(message, names) for message in received[:SHOWN]),
        tuple(sentences),
        before,
        unexpected=tuple(message.NAME for message in unexpected),
        missing=tuple(message.NAME for message in missing),
        wrong_status_keys=wrong_status_keys,
        wrong_timer=wrong_timer,
    )


def _timer_expired_early(
    model: ReferenceModel, expected: Sequence[Message], received: Sequence[Message], status: Mapping[str, Any]
) -> str | None:
    """Return the timer whose early expiry explains the received messages and the status. Return None if no early expiry
    explains them.

    To find this timer, the function lets timers of the reference expire. Afterwards, the state of the reference
    therefore differs from the state of the agent.
    """
    sent, first = list(expected), next_timer_name(model)
    for _ in range(MAX_EARLY_TIMERS):
        deadline = model.agent.next_timer()
        if deadline is None or not status:
            return None
        sent += model.feed(TimerExpiry(), deadline).sent
        expected_status = model.status()
        if received == sent and all(status.get(key, expected_status[key]) == expected_status[key] for key in COMPARED):
            return first
    return None
