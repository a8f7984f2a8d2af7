"""Collect the evidence for the checker: exported chains, traces, run.json, network records and packet captures.

Checks read only an `Evidence` object. It caches values that several checks derive from the files. Every part of the
evidence except the exports may be missing.
"""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ConfigDict

from harness.archive.archive import ReportProgress, RunArchive
from harness.archive.connectivity import Link
from harness.archive.exports import Export, name_blocks
from harness.archive.packets.capture_files import DIRECTORY, Captures, capture_files, read_captures
from harness.archive.run_journals import ChannelLine, MeasuredLag
from harness.archive.run_record import AgentRecord, Counters, JudgedRecord, RemoteRecord
from harness.archive.traces import Trace
from harness.archive.vocabulary import Kind, UnknownNames, first_unknown, unknown_names
from harness.checker._trace_replay import ReplayedIncarnation, replay
from harness.checker.judgement import Judgement
from harness.checker.recorded_inputs import sent_at, spread_of
from harness.checker.reference.state import ReferenceState
from harness.checker.signatures import TrustedKeys, are_signed
from harness.errors import RunDirectoryError
from harness.play.rogue.rogue_line import OF_NO_INJECTION
from harness.play.variant import VariantError, variant_in_use
from harness.scenario import Scenario
from harness.scenario.changes import NO_MORE_FATES
from harness.scenario.faults.fault import SAME_TIME_S
from harness.scenario.strict_model import parse_pairs
from netem.conditions import NetworkConditions
from netem.link import LinkConditions
from ucp.block import HASH_BYTES
from ucp.trace import CommandEntry, DroppedDatagram, HandlerRun, SentMessage
from ucp.trigger import MessageTrigger

if TYPE_CHECKING:
    from ucp.secure.crypto_suite import UnverifiedSignature

Derived = TypeVar("Derived")

Sending = tuple[tuple[float, SentMessage], ...]
"""The messages of one agent that have the same type and sequence number, each with the mission second at which the
agent sent the message. A second message exists only if the agent restarted, because a restarted agent numbers its
messages from 0 again.
"""
Sendings = dict[Any, dict[Any, Sending]]
"""The messages that one agent sent: message type -> sequence number -> messages."""

Watch = Callable[[ReferenceState, HandlerRun | None], None]
"""A function that receives each handler run of an agent, and the agent's state after the run. At the start of an
incarnation (the time between two restarts), the function receives None in place of a run.
"""

MAX_LINK_CHANGES = 20_000_000
"""Maximum product of the number of links and the number of network changes. Above this maximum, the checker does not
compute the loss rates of links, because the computation would take more than about ten seconds.
"""

_HASH = re.compile(f"[0-9a-f]{{{2 * HASH_BYTES}}}")


class InjectedDatagram(BaseModel):
    """A line of `rogue.jsonl`, the log of datagrams that a simulated attacker injected. The line describes one
    datagram, or contains only the number of several datagrams.
    """

    model_config = ConfigDict(extra="ignore", defer_build=True)

    message: str | None = None
    sender: int | None = None
    sequence: int | None = None
    count: int | None = None
    injection: int | None = None


class NetworkLogEntry(BaseModel):
    """A line of `network.jsonl`. It describes a change of the network, or a fault of agents."""

    model_config = ConfigDict(extra="ignore", defer_build=True)

    at_s: float
    what: str
    detail: str | None = None
    fully_connected: bool | None = None
    agents: list[int] | None = None
    disk: str | None = None
    planned_s: float | None = None
    asked: dict[str, Any] | None = None
    """The network conditions that the scenario requested, in the format of `NetworkConditions.to_json`."""
    counters: Counters | None = None
    """The packet counters of the kernel. Only the last line of the file contains counters."""


@dataclass
class RogueTraffic:
    """The messages that the rogue node injected according to the injection log. The rogue node is a sender outside the
    swarm.
    """

    messages: set[tuple[Any, Any, Any]] = field(default_factory=set)
    """The injected messages, each as (sender, sequence number, type)."""
    counted: bool = False
    """True if some lines of the log contain only a number of messages. Any message can then be an injected one."""
    outside_senders: set[int] = field(default_factory=set)
    """Senders of the datagrams that the scenario itself delivers. No agent of the scenario sends these datagrams, so
    the traces of their senders may be missing.
    """

    def add(self, datagrams: Iterable[InjectedDatagram]) -> "RogueTraffic":
        """Add injected datagrams to this object, and return the object."""
        for datagram in datagrams:
            self.messages.add((datagram.sender, datagram.sequence, datagram.message))
            self.counted |= datagram.count is not None
            if datagram.injection == OF_NO_INJECTION and datagram.sender is not None:
                self.outside_senders.add(datagram.sender)
        return self

    def may_include(self, trigger: MessageTrigger) -> bool:
        """Return true if the message that triggered a handler may come from the rogue node."""
        if not self.messages:
            return False
        return self.counted or (trigger.sender, trigger.sequence, trigger.message) in self.messages


@dataclass
class Evidence:
    """All recorded files of one run that the checker uses."""

    exports: dict[int, Export]
    traces: dict[int, Trace] = field(default_factory=dict)
    record: JudgedRecord | None = None
    """The content of `run.json`. None if there are only exports."""
    errors: list[str] = field(default_factory=list)
    before_final_reconcile: dict[int, Export] = field(default_factory=dict)
    """The exports that the agents wrote before the final reconcile. Empty if the run had no final reconcile."""
    injected: RogueTraffic = field(default_factory=RogueTraffic)
    conditions: list[NetworkLogEntry] | None = None
    """The lines of `network.jsonl`. None if the file is missing."""
    captures: Captures | None = None
    lag: MeasuredLag | None = None
    """The measured delays of the machine and of the agents' processes. None if the run has no such measurement."""
    keys: TrustedKeys | None = None
    """The public keys of a secured mission, which verify the signatures of blocks and exports."""
    verified: "Callable[[UnverifiedSignature], bool] | None" = None
    """A function that returns true if this process already knows that a signature is valid. The checker then need not
    verify the signature. None unless this process simulated the swarm.
    """
    watch: Watch | None = None
    """A function that receives each step that the step judge examines."""
    scenario: Scenario | None = None
    """The recorded scenario. It is None if the run has no record. It is also None if the scenario was only in memory,
    because such a scenario cannot have been edited after the run.
    """
    link_losses: list[tuple[float, dict[Link, float]]] = field(default_factory=list)
    """The changes of the loss rates (0 to 1) of links. Each entry contains the mission second of a change and the new
    loss rates of the changed links. The first entry contains all links.
    """
    delivers_all: bool = False
    """True if the simulation delivered every message that was not lost. False if the simulation saved time and did not
    deliver messages that the released agent core ignores.
    """
    from_field: bool = False
    """True for files without the run record run.json, for example from a real flight. Without the counters in run.json,
    the checker cannot know how many lines a trace should have, so lines may be missing.
    """
    steps: Judgement | None = None
    """The judgement on the steps, if the checker has already made it. None otherwise."""
    stores: dict[int, Path] = field(default_factory=dict)
    """Agent ID -> path of the file in which the agent last stored its state. Agents that stored no state are
    missing.
    """
    channel: list[ChannelLine] | None = None
    """The log of the radio channel that all vehicles share. None if the run has no such log."""
    report_progress: ReportProgress = lambda step: None
    """A function that receives the name of each long step of the checker."""
    _derived: dict[Callable[["Evidence"], Any], Any] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @cached_property
    def secured(self) -> bool:
        """True if a record shows that the mission was secured with keys and signatures."""
        return (
            self.keys is not None
            or (self.scenario is not None and self.scenario.security is not None)
            or any(trace.header.secured for trace in self.traces.values())
            or are_signed(self.exports.values())
        )

    @cached_property
    def sent_without_trace(self) -> bool:
        """True if agents of a secured mission may have sent datagrams that no trace contains. Such a datagram is a
        revocation of a key, a challenge or an echo. A restarted agent uses challenges and echoes to confirm that its
        peers are active.

        Agents send challenges and echoes only after a restart, or after a datagram that requires them.
        """
        return any(
            (trace.header.secured and trace.starts) or any(_needs_control_datagrams(aside) for _, aside in trace.asides)
            for trace in self.traces.values()
        )

    @cached_property
    def names(self) -> dict[str, str]:
        """Block hash -> short name of the block, such as 4.11 for the eleventh block of agent 4."""
        return name_blocks(self.exports)

    def name(self, block_hash: str) -> str:
        """Return the short name of the block, such as 4.11. If the block has no name, return the first 12 digits of its
        hash.
        """
        return self.names.get(block_hash, block_hash[:12])

    @cached_property
    def unknown(self) -> dict[int, UnknownNames]:
        """Agent ID -> the names in the agent's trace that the agent contract does not define, such as names of
        handlers. The dictionary contains only agents with at least one undefined name.
        """
        words = {agent_id: unknown_names(trace.runs) for agent_id, trace in self.traces.items()}
        return {agent_id: unknown for agent_id, unknown in words.items() if unknown}

    def describe_unknown_name(self, *kinds: Kind, agent_id: int | None = None) -> str | None:
        """Return a description of the first undefined name of these kinds (such as "handler") in the agent's trace.
        Return None if all names are defined. If `agent_id` is None, search all traces.
        """
        for named, unknown in self.unknown.items():
            if agent_id in (None, named) and (words := first_unknown(unknown, kinds)):
                return f"{words} in the trace of agent {named}"
        return None

    @cached_property
    def incarnations(self) -> dict[int, list[ReplayedIncarnation]]:
        """Agent ID -> the replayed incarnations of the agent. An incarnation is the time between two restarts."""
        inception = next((export.inception.chain_hash for export in self.exports.values()), None)
        if inception is None:
            states = (run.state for trace in self.traces.values() for run in trace.runs)
            inception = next((state.top for state in states if state.chain == 0 and _HASH.fullmatch(state.top)), None)
        return {agent_id: replay(trace, inception) for agent_id, trace in self.traces.items()}

    @cached_property
    def sendings(self) -> dict[Any, Sendings]:
        """The messages that each agent sent according to its trace."""
        sendings: dict[Any, Sendings] = {}
        for agent_id, trace in self.traces.items():
            of_agent: Sendings = defaultdict(dict)
            spread_s = spread_of(trace)
            for run in trace.runs:
                for message in run.sent:
                    of_type, sending = of_agent[message.message], (sent_at(run, message, spread_s), message)
                    earlier = of_type.get(message.seq)
                    of_type[message.seq] = (sending,) if earlier is None else (*earlier, sending)
            sendings[agent_id] = dict(of_agent)
        return sendings

    def cached(self, derive: Callable[["Evidence"], Derived]) -> Derived:
        """Return `derive(self)`. The first call stores the value, and later calls with the same function return the
        stored value.
        """
        if derive not in self._derived:
            self._derived[derive] = derive(self)
        derived: Derived = self._derived[derive]
        return derived

    @property
    def roster(self) -> list[int] | None:
        """The IDs of all agents of the mission. None if neither run.json nor a trace contains them."""
        if self.record is not None:
            return self.record.roster
        for trace in self.traces.values():
            return sorted(trace.header.roster)
        return None

    @property
    def missing(self) -> list[int]:
        """The agents that left no export. Killed agents are not included."""
        return [agent for agent in self.roster or [] if agent not in self.exports and not self.was_killed(agent)]

    def was_killed(self, agent_id: int) -> bool:
        """Return true if the scenario killed the agent together with its data and did not restart the agent."""
        agent = self.recorded(agent_id)
        return agent is not None and agent.outcome == "killed"

    def was_restarted(self, agent_id: int) -> bool:
        """Return true if the scenario restarted the agent. Its export then covers only the time since its last
        restart.
        """
        agent = self.recorded(agent_id)
        return agent is not None and agent.restarts > 0

    def recorded(self, agent_id: int) -> AgentRecord | None:
        """Return the entry of the agent in run.json. Return None if there is no entry."""
        return self.record.agents.get(str(agent_id)) if self.record else None

    def was_paused(self, agent_id: int, from_s: float, until_s: float) -> bool:
        """Return true if the scenario paused the agent at any time between these two mission seconds."""
        since: float | None = None
        for fault in self.record.faults if self.record else ():
            if agent_id not in (fault.agents or ()):
                continue
            if fault.kind.suspends_agent:
                since = fault.at_s
            elif since is not None and fault.kind.state_after is not None:
                if since <= until_s and fault.at_s >= from_s:
                    return True
                since = None
        return since is not None and since <= until_s

    def was_delayed(self, agent_id: int, due_s: float, until_s: float) -> bool:
        """Return true if the agent could not run between these two mission seconds. The reason is a pause, the measured
        lag, or a delay that the scenario requested.
        """
        if self.was_paused(agent_id, due_s, until_s):
            return True
        asked = self.record.lateness.get(agent_id, "") if self.record else ""
        if until_s - due_s <= max((delay_s for _, delay_s in parse_pairs(asked)), default=0.0) + SAME_TIME_S:
            return True
        lag_s = self.lag.explains(agent_id, due_s, until_s) if self.lag else None
        speedup = self.traces[agent_id].header.clock.get("speedup")
        return lag_s is not None and isinstance(speedup, int | float) and until_s - due_s <= lag_s * speedup

    @property
    def paused_at_end(self) -> list[int]:
        """The agents that are still paused when the run ends."""
        end_s = self.ended_at_s
        return [agent_id for agent_id in self.exports if end_s is not None and self.was_paused(agent_id, end_s, end_s)]

    @cached_property
    def switched_off(self) -> dict[int, float]:
        """Agent ID -> the mission second at which the agent was switched off. The dictionary contains only switched-off
        agents.
        """
        return self.record.switched_off if self.record else {}

    @property
    def present(self) -> dict[int, Export]:
        """The exports of the agents that ran until the end. If all agents were switched off, these are the exports of
        all agents.
        """
        there = {agent_id: export for agent_id, export in self.exports.items() if agent_id not in self.switched_off}
        return there or self.exports

    @property
    def presence_s(self) -> tuple[float, float]:
        """The interval (start, end) in mission seconds during which all agents in `present` ran and no other agent
        ran.
        """
        off_s = self.switched_off.values()
        if set(self.exports) <= set(self.switched_off):
            return 0.0, min(off_s, default=math.inf)
        return max(off_s, default=0.0), math.inf

    def end_of(self, agent_id: int) -> float | None:
        """Return the mission second at which the agent ended. Return None if no record contains this time."""
        return self.record.end_of(agent_id) if self.record else None

    def remote(self, agent_id: int) -> RemoteRecord | None:
        """Return the record of an agent on another computer. Return None for any other agent."""
        return self.record.remote.get(str(agent_id)) if self.record else None

    def send_failures(self, agent_id: int) -> int:
        """Return the number of messages that the agent could not send. Messages that were lost between the computer of
        a remote agent and the lab count, too.
        """
        recorded, remote = self.recorded(agent_id), self.remote(agent_id)
        return (recorded.send_failures or 0 if recorded else 0) + (remote.lost if remote else 0)

    def clock_error_s(self, agent_id: int) -> float:
        """Return the maximum error of the agent's clock, in seconds of wall time, relative to the harness's clock."""
        remote = self.remote(agent_id)
        speedup = self.traces[agent_id].header.clock.get("speedup")
        if remote is None or not isinstance(speedup, int | float) or speedup <= 0:
            return 0.0
        lasted_s = (self.ended_at_s or 0.0) / speedup
        return remote.clock_error_s(lasted_s)

    @property
    def busy(self) -> list[int]:
        """The agents that are not idle when the run ends. Paused and switched-off agents are not included."""
        gone = {*self.paused_at_end, *self.switched_off}
        return [agent_id for agent_id, export in self.exports.items() if not export.idle and agent_id not in gone]

    @property
    def ended_at_s(self) -> float | None:
        """The mission second at which the run ended. None if no record contains this time."""
        return self.record.mission_s if self.record else None

    @property
    def connected_since_s(self) -> float | None:
        """The mission second since which the network is fully connected. None if it is not fully connected at the end,
        or if no record shows it.
        """
        since: float | None = None
        for state in self.record.network if self.record else ():
            if not state.fully_connected:
                since = None
            elif since is None:
                since = state.at_s
        return since

    @property
    def network_at_end(self) -> str | None:
        """A description of the network at the end of the run. None if no record contains one."""
        return self.record.network[-1].detail if self.record and self.record.network else None

    @cached_property
    def requested_links(self) -> set[LinkConditions] | None:
        """All network conditions (loss, delay and others) that the scenario requested for links. None if no record
        contains them.
        """
        if self.requested_conditions is None:
            return None
        return set[LinkConditions]().union(*(asked.all_links() for _, asked in self.requested_conditions))

    @cached_property
    def requested_conditions(self) -> list[tuple[float, NetworkConditions]] | None:
        """The network conditions that the scenario requested, each with the mission second at which they took effect.
        None if no record contains them.
        """
        if self.conditions is None:
            return None
        asked = [(condition.at_s, condition.asked) for condition in self.conditions if condition.asked is not None]
        try:
            return [(at_s, NetworkConditions.from_json(conditions)) for at_s, conditions in asked]
        except (ValueError, TypeError, AttributeError, KeyError):
            return None

    @property
    def has_fates(self) -> bool:
        """True if the section `fates` of the scenario decided for each message whether it arrived. Otherwise the
        network decided.
        """
        return self.record is not None and any(state.what == NO_MORE_FATES for state in self.record.network)

    @property
    def has_channel(self) -> bool:
        """True if the vehicles shared one radio channel, on which messages wait for each other and can collide."""
        return self.record is not None and self.record.channel is not None

    def agents_with_unknown_completed(self) -> set[int]:
        """The agents whose completed blocks are unknown, because their traces contain undefined operations, or lack the
        end of an incarnation.
        """
        unknown = {agent_id for agent_id, words in self.unknown.items() if "operation" in words}
        remotes = self.record.remote if self.record else {}
        unknown |= {int(name) for name, remote in remotes.items() if remote.incomplete}
        return {agent for agent in unknown if agent not in self.exports or self.was_restarted(agent)}

    def completed_blocks(self) -> dict[str, int]:
        """Block hash -> the agent that completed the block."""
        return self._completed_blocks

    @cached_property
    def _completed_blocks(self) -> dict[str, int]:
        owners = {block: agent_id for agent_id, export in self.exports.items() for block in export.completed}
        for name, agent in self.record.agents.items() if self.record else ():
            owners.update(dict.fromkeys(agent.completed_before, int(name)))
        for agent_id, trace in self.traces.items():
            owners.update(dict.fromkeys(trace.completed(), agent_id))
        return owners


def _needs_control_datagrams(aside: DroppedDatagram | CommandEntry) -> bool:
    if isinstance(aside, CommandEntry):
        return aside.command == "revoke"
    return aside.dropped in ("not confirmed", "old boot")


def gather(archive: RunArchive) -> Evidence:
    """Return the evidence in an archive. Raises VariantError if the run used a different variant of the protocol."""
    check_variant(archive)
    problems = list(archive.problems)
    if archive.record_problems and archive.judged_record is None:
        problems[0] += "; the exports are checked without it"
    injected = RogueTraffic().add(archive.injected(InjectedDatagram))
    return Evidence(
        archive.exports.by_agent,
        {agent_id: _marked(trace, archive.judged_record) for agent_id, trace in archive.traces.items()},
        archive.judged_record,
        problems,
        archive.before_final_reconcile,
        injected,
        archive.conditions(NetworkLogEntry),
        _captures(archive),
        archive.lag(),
        TrustedKeys(archive.public_keys, archive.anchor) if archive.public_keys else None,
        scenario=archive.record.scenario,
        link_losses=_link_losses(archive),
        delivers_all=_delivers_all(archive),
        stores=archive.stores,
        channel=archive.channel(),
        report_progress=archive.report_progress,
    )


def _marked(trace: Trace, record: JudgedRecord | None) -> Trace:
    """Return the trace unchanged, unless the agent ran on another computer and the end of an incarnation is missing
    from the trace. In this case, return a copy of the trace that names the problem.
    """
    remote = record.remote.get(str(trace.header.agent_id)) if record else None
    if remote is None or not remote.incomplete or trace.problem:
        return trace
    return replace(trace, problem=remote.lack)


def check_variant(archive: RunArchive) -> None:
    """Raise VariantError if the run and this process use different variants of the protocol."""
    if not archive.recorded:
        return
    made_with, variant = archive.record.versions.get("variant"), variant_in_use()
    if made_with == (variant and variant.version):
        return
    if made_with is None:
        raise VariantError(f"{archive.directory}: the run was made without a variant: leave out --variant")
    given = "" if variant is None else f", not with {variant.version}"
    raise VariantError(
        f"{archive.directory}: the run was made with the variant {str(made_with)[:80]}{given}: name its file with "
        "--variant"
    )


def _link_losses(archive: RunArchive) -> list[tuple[float, dict[Link, float]]]:
    """Return the loss rate of each link over time. Return an empty list if the computation would take too long."""
    changes = len(archive.conditions(NetworkLogEntry) or ())
    if changes * len(archive.roster) ** 2 > MAX_LINK_CHANGES:
        return []
    return [*archive.link_losses(archive.roster)]


def _delivers_all(archive: RunArchive) -> bool:
    versions = archive.record.versions if archive.recorded else {}
    return str(versions.get("core")).startswith("edited") or versions.get("variant") is not None


def _captures(archive: RunArchive) -> Captures | None:
    """Return the packet captures of a run. Return None if the run has no captures."""
    if archive.directory is None or not (archive.directory / DIRECTORY).is_dir():
        return None
    try:
        return read_captures(capture_files([archive.directory]))
    except RunDirectoryError:
        return None
