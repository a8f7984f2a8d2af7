"""Convert the states and settings of real agents and of the TLA+ specification to the same form.

Blocks are called 1, 2, ... in the order in which they were completed. A chain hash is represented by the blocks of its
chain.
"""

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness.proof.graph._exploration import StateGraph
from harness.proof.model._global_states import AGENTS
from harness.proof.model._local_steps import LocalStates
from harness.proof.specification._tlc import MODULES
from harness.scenario.agent_options import Staggered
from ucp.clock import MICROSECONDS
from ucp.settings import CHOICES, DECLARED, Settings
from ucp.state import AgentState

Plain = tuple[Any, ...]
"""The state of an agent or of all agents as nested tuples. It is the same for real agents and for the specification."""

TIMERS: dict[Staggered, tuple[str, str]] = {
    "vote_timeout_s": ("VoteTimeout", "VoteStagger"),
    "phase1_timeout_s": ("Phase1Timeout", "Phase1Stagger"),
    "phase2_timeout_s": ("Phase2Timeout", "Phase2Stagger"),
    "phase3_timeout_s": ("Phase3Timeout", "Phase3Stagger"),
    "finalize_gap_s": ("FinalizeGap", "FinalizeStagger"),
}
"""Timer -> the constants of the specification for its duration and for the stagger between agents."""
SIZES = {"max_block_bytes", "max_event_bytes"}
"""Settings that the specification has as constants for sizes."""
NO_HASH = -1
TOP_OF_CHAIN = 0
_SIGNS = str.maketrans({"{": "\1", "}": "\2", "[": "{", "]": "}", "(": "{", ")": "}"})
_WORDS = {"<<": "[", ">>": "]", "\1": "[", "\2": "]", " @@": ",", ":>": ":", "TRUE": "true", "FALSE": "false"}
_NODE = re.compile(r'-?\d+ \[label="((?:[^"\\]|\\.)*)"')
_EDGE = re.compile(r"(-?\d+) -> (-?\d+)")
_FIELD = re.compile(r"(\w+) \|->")


def specified(graph: Path) -> Iterator[Plain]:
    """Yield all states that TLC found in the specification."""
    with graph.open() as lines:
        for line in lines:
            if node := _NODE.match(line):
                text = node[1].replace("\\n", " ").replace('\\"', '"').replace("\\\\", "\\")
                yield tuple(map(_of_record, _value(text.partition("=")[2])))


def goes_round(graph: Path) -> bool:
    """Return true if the state graph that TLC wrote contains a cycle, which is an endless run."""
    after: dict[str, set[str]] = defaultdict(set)
    with graph.open() as lines:
        for line in lines:
            if edge := _EDGE.match(line):
                after[edge[1]].add(edge[2])
    ways_in = Counter(other for others in after.values() for other in others)
    waiting = [state for state in after if not ways_in[state]]
    while waiting:
        for other in after.pop(waiting.pop(), ()):
            ways_in[other] -= 1
            if not ways_in[other]:
                waiting.append(other)
    return bool(after)


def _value(text: str) -> Any:
    """Convert a TLA+ value to a Python value. Sets become lists."""
    text = text.translate(_SIGNS)
    for sign, other in _WORDS.items():
        text = text.replace(sign, other)
    return json.loads(_FIELD.sub(r'"\1":', text))


def _of_record(agent: dict[str, Any]) -> Plain:
    def hashes(blocks: list[dict[str, Any]]) -> Plain:
        return tuple(block["hash"] for block in blocks)

    return (
        tuple((link["block"]["hash"], link["chainHash"]) for link in agent["blockChain"]),
        hashes(agent["blocksToBeCommittedDeque"]),
        hashes(agent["reconcileStack"]),
        hashes(agent["completed"]),
        agent["currentBlock"],
        tuple(sorted(name for name, left in agent["timer"].items() if left)),
        agent["candidateBlock"]["hash"],
        agent["topChainHashAtInitiation"],
        (agent["voteCount"]["yes"], agent["voteCount"]["no"], *sorted(agent["voters"])),
        agent["reconcileInProgress"],
        (agent["reconcileVoteCount"]["yes"], agent["reconcileVoteCount"]["no"]),
        tuple(sorted(agent["responders"])),
        tuple(sorted((r["blockHash"], r["count"], r["timestamp"]) for r in agent["reconcileResponseDictionary"])),
        agent["majorityResponseBlockHash"],
    )


def real(graph: StateGraph) -> Iterator[Plain]:
    """Yield all states that `harness.proof` found, without the remaining times of their timers."""
    translator = _HashTranslator(graph.swarm.local)
    for state in graph.states:
        yield tuple(map(translator.plain, state[AGENTS:]))


class _HashTranslator:
    """A converter from the hashes of real agents to the names that the specification uses."""

    def __init__(self, local: LocalStates) -> None:
        self._local = local
        self._plain: dict[int, Plain] = {}
        self._block: dict[bytes, int] = {b"": TOP_OF_CHAIN}
        self._chain: dict[bytes, int] = {b"": NO_HASH}
        for number in range(len(local.known)):
            state = local.state(number)
            self._chain[state.chain.inception.chain_hash] = below = 0
            for block in (*state.chain, *state.blocks_to_be_committed, *state.reconcile_stack):
                self._block[block.block_hash] = block.timestamp_us // MICROSECONDS
            for block, chain_hash in state.chain.with_chain_hashes():
                self._chain[chain_hash] = below = 10 * below + self._block[block.block_hash]

    def plain(self, number: int) -> Plain:
        if number not in self._plain:
            self._plain[number] = self._of_state(self._local.state(number))
        return self._plain[number]

    def _of_state(self, state: AgentState) -> Plain:
        block, votes, answers = self._block, state.vote_count, state.reconcile_vote_count
        candidate, majority = state.candidate_block, state.majority_response_block_hash
        return (
            tuple((block[link.block_hash], self._chain[top]) for link, top in state.chain.with_chain_hashes()),
            tuple(block[waiting.block_hash] for waiting in state.blocks_to_be_committed),
            tuple(block[popped.block_hash] for popped in state.reconcile_stack),
            tuple(block[block_hash] for block_hash in state.completed),
            len(state.current_block),
            tuple(sorted(timer.name for timer in state.timers if timer.active)),
            NO_HASH if candidate is None else block[candidate.block_hash],
            self._chain[state.top_chain_hash_at_initiation],
            (votes["yes"], votes["no"], *sorted(state.voters)),
            state.reconcile_in_progress,
            (answers["yes"], answers["no"]),
            tuple(sorted(state.reconcile_responders)),
            tuple(
                sorted(
                    (block[name], count, timestamp_us // MICROSECONDS)
                    for name, (count, timestamp_us) in state.reconcile_response_dictionary.items()
                )
            ),
            NO_HASH if majority is None else block[majority],
        )


def unspecified(settings: Settings) -> str | None:
    """Return the name of a setting that does not have its default and that the specification does not support. Return
    None if there is none.
    """
    constants = (MODULES / "Swarm.tla").read_text("utf-8")
    choices = {name for name, choice in CHOICES.items() if choice.constant is not None and choice.constant in constants}
    known, usual = choices | TIMERS.keys() | SIZES, Settings()
    return next(
        (name for name in DECLARED if name not in known and getattr(settings, name) != getattr(usual, name)), None
    )


def readings(settings: Settings) -> dict[str, bool]:
    """Return the constants of the specification that represent these settings."""
    return {
        choice.constant: getattr(settings, name) != choice.values[0]
        for name, choice in CHOICES.items()
        if choice.constant is not None
    }
