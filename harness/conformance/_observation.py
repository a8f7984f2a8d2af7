"""What one step of an agent showed, compared with the reference, and its words for people."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harness.conformance._alphabet import Input
from harness.conformance._reference_model import AGENT, Expire, Model, Outcome, Run
from harness.conformance._state_space import Pair, State, ends_next, pair_of
from harness.report.stories.story_names import INCEPTION, in_words
from ucp.block import next_chain_hash
from ucp.messages import MalformedDatagramError, Message, decode


class Names:
    """What the reference knows by now."""

    def __init__(self, model: Model) -> None:
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
            below, chain_hash = self._chains[chain_hash], next_chain_hash(chain_hash, block.block_hash)
            text = f"{text} {self.block(block.block_hash.hex())}".strip()
            self._chains[chain_hash], self._below[chain_hash] = text, below
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


def told(message: Message, names: Names) -> str:
    """ "Commit Block (1.1 on inception)"."""
    return in_words(message, names)


def told_datagram(data: bytes, names: Names) -> str:
    try:
        return told(decode(data).message, names)
    except MalformedDatagramError as error:
        return f"{len(data)} bytes that are an invalid message ({error.reason}): {data[:24].hex()}"


COMPARED = ("idle", "reconcile_in_progress", "chain", "deque", "stack", "completed", "reconciles", "top_chain_hash")
"""Keys of the status; what is not there is not compared."""
SHOWN = 12
MOST_ENDED = 3
"""Timers that may have ended one after the other."""


@dataclass(frozen=True)
class Exchange:
    """A datagram that crossed the air: mission second, whether the agent sent it, what, and what that says."""

    t: float
    sent: bool
    data: bytes
    text: str


@dataclass(frozen=True)
class Seen:
    """One step: what came of an input, beside what should have."""

    pair: Pair
    outcome: Outcome
    given: str
    expected: tuple[str, ...]
    came: tuple[str, ...]
    wrong: tuple[str, ...]
    """In sentences; none if all is as it should be."""
    before: State
    late: bool = False
    """The machine was so late that nothing can be said."""
    unexpected: tuple[str, ...] = ()
    """Names of messages that should not have come."""
    missing: tuple[str, ...] = ()
    misstated: tuple[str, ...] = ()
    """Keys of the status that are wrong."""
    mistimed: str | None = None
    """The timer that ended, or would end, at another time than it should."""
    started: str | None = None
    """The timer that runs as it should, where that can be seen."""
    ended: str | None = None
    """How the agent ended by itself, or that it hangs."""
    hidden: Run | None = None
    """What should have changed nothing, just before; or should have stopped a timer."""


def compare(
    model: Model,
    given: Input,
    before: State,
    outcome: Outcome,
    datagrams: Iterable[bytes],
    status: Mapping[str, Any],
    wrong: Iterable[str],
) -> Seen:
    """What the agent sent for an input that the reference has been given, and its status after it.

    `wrong` is what is known to be wrong already.
    """
    sentences, names, came = list(wrong), Names(model), list[Message]()
    for data in datagrams:
        try:
            sender, _, message = decode(data)
        except MalformedDatagramError:
            sentences.append(f"it sent {told_datagram(data, names)}")
            continue
        if sender != AGENT:
            sentences.append(f"it sent a message as agent {sender}")
        came.append(message)
    missing = [message for message in outcome.sent if message not in came]
    unexpected = [message for message in came if message not in outcome.sent]
    if came != outcome.sent:
        sentences += [f"it did not send {told(message, names)}" for message in missing]
        sentences += [f"it sent {told(message, names)}" for message in unexpected[:SHOWN]]
        if not missing and not unexpected:
            sentences.append("it sent its messages in another order, or sent one of them twice")
    should = model.status()
    misstated = tuple(key for key in COMPARED if key in status and status[key] != should[key])
    sentences += [f"its status says {key} {status[key]!r}, not {should[key]!r}" for key in misstated]
    mistimed = _as_if_ended(model, outcome.sent, came, status) if sentences else None
    if mistimed is not None:
        sentences.append(f"its timer {mistimed} seems to have expired already")
    return Seen(
        pair_of(before, given),
        outcome,
        given.name,
        tuple(told(message, names) for message in outcome.sent),
        tuple(told(message, names) for message in came[:SHOWN]),
        tuple(sentences),
        before,
        unexpected=tuple(message.NAME for message in unexpected),
        missing=tuple(message.NAME for message in missing),
        misstated=misstated,
        mistimed=mistimed,
    )


def _as_if_ended(
    model: Model, expected: Sequence[Message], came: Sequence[Message], status: Mapping[str, Any]
) -> str | None:
    """The timer that the agent seems to have let end before its time; the reference is of no use any more then."""
    sent, first = list(expected), ends_next(model)
    for _ in range(MOST_ENDED):
        deadline = model.agent.next_timer()
        if deadline is None or not status:
            return None
        sent += model.feed(Expire(), deadline).sent
        should = model.status()
        if came == sent and all(status.get(key, should[key]) == should[key] for key in COMPARED):
            return first
    return None
