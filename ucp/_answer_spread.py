"""Delay the answers of an agent by a random time, if the setting `answer_spread_s` is above 0.

When one agent sends a query, all other agents answer at the same moment. On a shared radio channel, many of these
answers collide. With `answer_spread_s`, each agent delays its answer by a different part of this time.

The delay is computed from a hash of the datagram. An agent therefore draws no random number, a repeated run sends at
the same times, and a checker can compute the delay. A hash is as good as a random number here, because no two datagrams
are equal. Each datagram contains its sender and its sequence number.
"""

from heapq import heappop, heappush

from ucp.block import hash_digest
from ucp.messages import (
    BlockAddResponse,
    BlockResponse,
    ChainContainResponse,
    Message,
    NextInSequenceResponse,
    encode,
)
from ucp.trace import RecordedBytes

ANSWERS = frozenset((BlockAddResponse, ChainContainResponse, NextInSequenceResponse, BlockResponse))
"""Messages that the agent delays. Algorithms 3, 9, 13 and 17 send them."""

Outgoing = tuple[int, Message, RecordedBytes | None]
"""An outgoing message: its sequence number, the message, and its datagram for the trace. The datagram is None if the
agent writes no trace.
"""


def answer_wait_s(datagram: bytes, spread_s: float) -> float:
    """Return the number of mission seconds, from 0 to `spread_s`, by which an answer is delayed.

    `datagram` is the encoded message. In a secured mission, it is the message before encryption.
    """
    return spread_s * (int.from_bytes(hash_digest(datagram)[:8], "big") / 2**64)


class WaitingAnswers:
    """The answers of one agent that wait for their sending times."""

    def __init__(self, agent_id: int, spread_s: float) -> None:
        self._agent_id = agent_id
        self._spread_s = spread_s
        self._waiting: list[tuple[float, int, Outgoing]] = []
        self._count = 0

    def next_s(self) -> float | None:
        """Return the mission second at which the next answer is due. Return None if no answer waits."""
        return self._waiting[0][0] if self._waiting else None

    def exchange(self, outbox: list[Outgoing], now: float) -> list[Outgoing]:
        """Add the answers in `outbox` to the waiting answers. Return all messages to send now, in order.

        Answers that are due come first. The messages in `outbox` that are not answers follow.
        """
        others = []
        for outgoing in outbox:
            sequence, message, _ = outgoing
            if type(message) in ANSWERS:
                wait_s = answer_wait_s(encode(self._agent_id, sequence, message), self._spread_s)
                self._count += 1
                heappush(self._waiting, (now + wait_s, self._count, outgoing))
            else:
                others.append(outgoing)
        due = []
        while self._waiting and self._waiting[0][0] <= now:
            due.append(heappop(self._waiting)[2])
        return due + others
