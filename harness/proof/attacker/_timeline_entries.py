"""Write the messages of an attacker as timeline entries of a scenario, with block names and mission seconds."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from harness.play.rogue.lies import MADE, NOBODYS
from harness.proof.model._local_steps import LocalStates
from ucp.block import Block, next_chain_hash
from ucp.clock import MICROSECONDS
from ucp.messages import CommitBlock, Message, NextInSequenceResponse, block_named

Document = dict[str, Any]


class AttackEntries:
    """The timeline entries of a scenario for the messages that an attacker sends on one path through the states. `made`
    maps the hash of each block that the attacker created to the block.
    """

    def __init__(self, local: LocalStates, captured: int, made: Mapping[bytes, Block]) -> None:
        self._local = local
        self._captured = captured
        self._made = made
        self._lies: list[tuple[Document, Message]] = []
        """The timeline entries, each with its message."""
        self._names: dict[bytes, str] = {}
        self._chains: dict[bytes, tuple[bytes, ...]] = {}
        self._count: Counter[int] = Counter()
        self._completed_s = [0.0]
        """Mission second at which each block was completed. The first element is the inception block."""

    def completed(self, agent_id: int, ordinal: int, at_s: float) -> None:
        """Record that an agent completed a block. `ordinal` is the number of the block among all blocks of the path."""
        self._count[agent_id] += 1
        self._names[self._local.blocks.completed_by(agent_id, ordinal)] = f"{agent_id}.{self._count[agent_id]}"
        self._completed_s.append(at_s)

    def sees(self, local: int) -> None:
        """Record the chain hashes that an agent knows in this state, so that timeline entries can name the chains."""
        chain = self._local.state(local).chain
        below: tuple[bytes, ...] = ()
        self._chains[chain.inception.chain_hash] = below
        for block, chain_hash in chain.with_chain_hashes():
            below = self._chains[chain_hash] = (*below, block.block_hash)

    def lie(self, receiver: int, number: int, at_s: float) -> list[Document]:
        """Add a message of the attacker. Return a list with a new timeline entry, which is incomplete until the method
        `word` completes it.

        If the previous message of the attacker has the same content and time, add the receiver to the entry of the
        previous message instead, and return an empty list.
        """
        message = self._local.messages[number]
        if self._lies and (self._lies[-1][0]["at_s"], self._lies[-1][1]) == (at_s, message):
            self._lies[-1][0]["lie"]["receivers"].append(receiver)
            return []
        entry: Document = {"at_s": at_s, "lie": {"sender": self._captured, "receivers": [receiver]}}
        self._lies.append((entry, message))
        return [entry]

    def word(self) -> None:
        """Fill in the block names and mission seconds of all timeline entries. Call this method when the whole path is
        known.
        """
        for entry, message in self._lies:
            entry["lie"] |= self._message_keys(message)

    def _message_keys(self, message: Message) -> Document:
        said: Document = {"message": message.NAME}
        block_hash = block_named(message)
        if block_hash is not None:
            said["block"] = self._name(block_hash)
        chain_hash = getattr(message, "chain_hash", None)
        if isinstance(message, CommitBlock):
            chain_hash = self._below(message)
        if chain_hash is not None:
            known = self._chains.get(chain_hash)
            said["chain"] = "nobody's" if known is None else [self._name(block_hash) for block_hash in known]
        for key in ("approve", "contained"):
            if hasattr(message, key):
                said["approve"] = getattr(message, key)
        if isinstance(message, NextInSequenceResponse):
            said["timestamp_s"] = self._second(message.timestamp_us)
        return said

    def _below(self, commit: CommitBlock) -> bytes:
        """Return the hash of the chain to which a Commit Block message adds its block."""
        return next(
            (below for below in self._chains if next_chain_hash(below, commit.block.block_hash) == commit.chain_hash),
            NOBODYS,
        )

    def _name(self, block_hash: bytes) -> str:
        name = self._names.get(block_hash)
        if name is not None:
            return name
        second = f"{self._second(self._made[block_hash].timestamp_us):.6f}"
        return MADE + second.rstrip("0").rstrip(".")

    def _second(self, timestamp_us: int) -> float:
        """Return the mission second for a timestamp that lies between the timestamps of completed blocks.

        A timestamp after all blocks gives a mission second after the last completion.
        """
        ordinal, part = divmod(timestamp_us, MICROSECONDS)
        last = len(self._completed_s) - 1
        if ordinal >= last:
            return round(self._completed_s[last] + ordinal - last + part / MICROSECONDS, 6)
        begin, end = self._completed_s[ordinal : ordinal + 2]
        return round(begin + (end - begin) * part / MICROSECONDS, 6)
