"""Record example missions of one agent. A function gives inputs to the agent, and this module stores the inputs and the
outputs.
"""

import base64
import json
from typing import Any

from ucp.block import Block, InceptionBlock
from ucp.chain import Chain
from ucp.contract.schemas._control_schema import STATUS
from ucp.events import LoggableEvent
from ucp.features import CONTRACT, needed_features
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    Message,
    NextInSequenceResponse,
    decode,
    encode,
)
from ucp.mission import SCHEMA
from ucp.settings import Settings
from ucp.trace import in_base64
from ucp.virtual import VirtualAgent

AGENT_ID = 7
ROSTER = (1, 7, 28, 300)
INITIAL_DATA = b"test"
MICROSECONDS = 1_000_000


class RecordedMission:
    """A recorded mission of agent 7. `exchanges` contains each input with its outputs.

    Times are mission seconds of the agent, and `now` is the time of the last input. The function that records the
    mission sends the messages of the other agents. Their datagrams share one counter of sequence numbers, because the
    protocol does not use these numbers.
    """

    initial_data = INITIAL_DATA

    def __init__(self, *, roster: tuple[int, ...] = ROSTER, epoch_us: int = 0, at_s: float = 0.0, **settings: Any):
        self.exchanges: list[dict[str, Any]] = []
        self.now = at_s
        self._epoch_us = epoch_us
        self._sequence = 0
        self._roster = roster
        self._settings = settings
        self.begin()

    # Inputs

    def begin(self, **store: Any) -> None:
        """Start the agent. `store` contains the data that the agent stored before it last ended."""
        self._agent: VirtualAgent | None = None
        settings = Settings().to_json() | self._settings
        mission: dict[str, Any] = {
            "schema": SCHEMA,
            "contract": CONTRACT,
            "features": [],
            "agent_id": AGENT_ID,
            "roster": list(self._roster),
            "initial_data": in_base64(self.initial_data),
            "network": {"address": "10.77.0.7", "broadcast": "10.79.255.255", "port": 14600},
            "events": {"source": "none"},
            "settings": settings,
            "quirks": {},
            "seed": 0,
            "speedup": 1,
            "epoch_us": self._epoch_us,
            "store": None,
            **self._of_mission(),
        }
        mission["features"] = needed_features(mission)
        self._exchange({"mission": mission, "trace": True, **self._of_life(), **store})

    def _of_mission(self) -> dict[str, object]:
        """Return additional keys for the mission file. The base class has none."""
        return {}

    def _of_life(self) -> dict[str, object]:
        """Return additional keys for the input line that starts the agent. The base class has none."""
        return {}

    def log(self, data_bytes: int = 256, *, after_s: float = 1.0, event_id: int = 5) -> None:
        """Log an event with `data_bytes` bytes of data. Like every method with the argument `after_s`, the method first
        lets this number of mission seconds pass.
        """
        self.now += after_s
        timestamp_us = self._epoch_us + round(self.now * MICROSECONDS)
        data = bytes((event_id + offset) % 256 for offset in range(data_bytes))
        self._exchange({"event_id": event_id, "data": in_base64(data), "timestamp_us": timestamp_us})

    def complete_a_block(self) -> None:
        """Log three events of the largest size. Together they complete a block."""
        for _ in range(3):
            self.log()

    def hear(self, sender: int, message: Message, *, after_s: float = 0.125) -> None:
        """Give the agent a message from another agent."""
        self._sequence += 1
        self.hear_datagram(self._encoded(sender, self._sequence, message), after_s=after_s)

    def _encoded(self, sender: int, sequence: int, message: Message) -> bytes:
        """Return a message from another agent as a datagram."""
        return encode(sender, sequence, message)

    def _message(self, datagram: bytes) -> Message | None:
        """Return the message in a datagram that the agent sent. Return None if the datagram contains no message."""
        return decode(datagram).message

    def hear_datagram(self, datagram: bytes, *, after_s: float = 0.125) -> None:
        """Give the agent a datagram, which may be invalid."""
        self.now += after_s
        self._exchange({"datagram": in_base64(datagram)})

    def wait(self, *, late_s: float = 0.0) -> None:
        """Wait until the next timer of the agent expires. The agent handles the expiry `late_s` mission seconds
        late.
        """
        assert self.timer is not None, "no timer runs"
        self.now = self.timer + late_s
        self._exchange({"timer": True})

    def wait_until(self, at_s: float) -> None:
        """Wait until mission second `at_s`, and let all due timers expire."""
        self.now = at_s
        self._exchange({"timer": True})

    def command(self, name: str, *, after_s: float = 0.5, **keys: Any) -> None:
        """Send a command to the agent: a command of the control socket, or the command `store`."""
        self.now += after_s
        self._exchange({"command": name, **keys})

    def reboot(self, *, down_s: float = 30.0) -> None:
        """Switch the agent off for `down_s` mission seconds, and restart it with its stored data."""
        self.command("store")
        line = len(self.exchanges)
        store = self.output["answer"].pop("store")
        self.now += down_s
        self.begin(store=store)
        self.exchanges[-1]["input"]["store"] = {"answer_of_line": line}

    def _exchange(self, given: dict[str, Any]) -> None:
        given = {"t": self.now, **given}
        if self._agent is None:
            self._agent = VirtualAgent(given)
        else:
            self._agent.give(given)
        self.output: dict[str, Any] = json.loads(self._agent.answer())
        if given.get("command") == "status":
            answer = self.output["answer"]
            self.output["answer"] = {key: answer[key] for key in ("ok", *STATUS)}
        self.exchanges.append({"input": dict(given), "output": self.output})

    # Results of the last input

    @property
    def timer(self) -> float | None:
        """The mission second at which the next timer of the agent expires."""
        ends: float | None = self.output["timer"]
        return ends

    @property
    def sent(self) -> list[Message]:
        """All messages that the agent has broadcast."""
        messages = (self._message(base64.b64decode(datagram)) for datagram in self.output["sent"])
        return [message for message in messages if message is not None]

    # Answers of other agents to the last request

    def vote(self, *votes: tuple[int, bool]) -> None:
        """Give the agent votes on its last proposed block. Each vote is (voter, approve)."""
        for sender, approve in votes:
            self.hear(sender, BlockAddResponse(self._last(BlockAddRequest).block_hash, approve))

    def contain(self, *answers: tuple[int, bool]) -> None:
        """Answer the agent's last query of reconcile phase 1. Each answer is (responder, contained)."""
        for sender, contained in answers:
            self.hear(sender, ChainContainResponse(self._last(ChainContainQuery).chain_hash, contained))

    def name(self, *answers: tuple[int, Block | None], top_us: int = 0) -> None:
        """Answer the agent's last query of reconcile phase 2. Each answer is (responder, next block).

        The next block None stands for "Is Top Of Chain". These answers have the timestamp `top_us`.
        """
        for sender, block in answers:
            chain_hash = self._last(ChainHashSuccessorQuery).chain_hash
            block_hash, timestamp_us = (block.block_hash, block.timestamp_us) if block is not None else (None, top_us)
            self.hear(sender, NextInSequenceResponse(chain_hash, block_hash, timestamp_us))

    def _last(self, question: type[Any]) -> Any:
        """Return the last message of this type that the agent sent."""
        for exchange in reversed(self.exchanges):
            for datagram in reversed(exchange["output"]["sent"]):
                message = self._message(base64.b64decode(datagram))
                if isinstance(message, question):
                    return message
        raise AssertionError(f"it has sent no {question.__name__}")

    def proposed(self) -> bytes:
        """Return the block hash of the agent's last proposal."""
        block_hash: bytes = self._last(BlockAddRequest).block_hash
        return block_hash


def others_block(agent_id: int, ordinal: int, *, at_s: float = 0.0) -> Block:
    """Return a new block of another agent."""
    timestamp_us = round(at_s * MICROSECONDS) + ordinal
    return Block(agent_id, timestamp_us, LoggableEvent(timestamp_us, ordinal, b"of another agent").encode())


def chain_of(*blocks: Block) -> Chain:
    """Return a chain with these blocks."""
    chain = Chain(InceptionBlock(INITIAL_DATA))
    for block in blocks:
        chain.append(block)
    return chain
