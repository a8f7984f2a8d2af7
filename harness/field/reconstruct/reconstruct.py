"""From what came home to a scenario that flies it again, and whether it does."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from harness.archive.exports import Export
from harness.checker import Evidence, steps
from harness.checker.judgement import agents
from harness.checker.steps.header import CheckedHeader
from harness.errors import FieldError
from harness.field.homecoming import Flight
from harness.field.reconstruct.comparing import FirstDifference, first_difference
from harness.field.reconstruct.elsewhere import Elsewhere
from harness.field.reconstruct.inferring import infer
from harness.field.reconstruct.inputs import Input, UnusableInputError, lives_of
from harness.field.reconstruct.rehearsal import Allowed, Parting, Rehearsal, rehearse
from harness.field.reconstruct.script import scenario_of
from harness.field.reconstruct.timetable import Timetable, timetable
from harness.field.reconstruct.told import NOTHING, told
from harness.run.simulate import InMemory, Simulated, simulate_in_memory
from harness.scenario.load import parse
from harness.scenario.write import Document
from ucp.clock import MICROSECONDS
from ucp.quirks import QUIRKS

SEED = 1
"""Of the reconstruction, in which nothing is left to chance."""

Tell = Callable[[str], None]
Lives = Sequence[Sequence[Input]]


@dataclass(frozen=True)
class AgentOutcome:
    """What became of one agent: how many `blocks` its chain has in virtual time, and `why` that is not its flight."""

    agent_id: int
    blocks: int
    why: str | None = None


@dataclass
class Reconstruction:
    """A scenario, and what it reproduces.

    `agents` are those that left a record; `remarks` say what was assumed; `difference` is the first step at which
    virtual time did something else than the record of an agent that was to be played in full.
    """

    document: Document
    agents: list[AgentOutcome]
    remarks: list[str]
    difference: FirstDifference | None
    simulated: Simulated
    table: Timetable = field(repr=False)

    @property
    def problems(self) -> list[str]:
        """Why it is not the whole flight, the first place first; empty if it is."""
        first = [self.difference.sentence] if self.difference else []
        return first + [f"agent {agent.agent_id} {agent.why}" for agent in self.agents if agent.why]

    @property
    def blocks(self) -> int:
        """How many there are in the chains that came out as they did."""
        exports = self.simulated.evidence.exports
        chains = (exports[agent].chain_of_block_hashes for agent in self.reproduced if agent in exports)
        return len({block for chain in chains for block in chain})

    @property
    def reproduced(self) -> list[int]:
        return [agent.agent_id for agent in self.agents if agent.why is None]

    @property
    def sentence(self) -> str:
        """What it comes to."""
        whole, all_of_them = len(self.reproduced), len(self.agents)
        if not self.problems:
            chains = "the chain" if whole == 1 else f"all {whole} chains"
            return f"reproduces {chains}, {self.blocks} blocks"
        return f"reproduces {whole} of {all_of_them} chains: {self.problems[0]}"

    def to_json(self) -> dict[str, Any]:
        exports = self.simulated.evidence.exports
        return {
            "reproduced": not self.problems,
            "chains": {
                str(agent.agent_id): {
                    "blocks": agent.blocks,
                    "top_chain_hash": exports[agent.agent_id].top_chain_hash if agent.agent_id in exports else None,
                    "reproduced": agent.why is None,
                    "why": agent.why,
                }
                for agent in self.agents
            },
            "blocks": self.blocks,
            "first_difference": None
            if self.difference is None
            else {
                "agent_id": self.difference.agent_id,
                "at_s": round(self.difference.at_s, 6),
                "line": self.difference.line,
                "handler": self.difference.handler,
                "recorded": self.difference.recorded,
                "played": self.difference.played,
            },
            "problems": self.problems,
            "remarks": self.remarks,
        }


def reconstruct(flight: Flight, name: str, tell: Tell = lambda sentence: None) -> Reconstruction:
    """Fly it again. `tell` is told what is being done. Raises FieldError if there is nothing to fly it by."""
    tell("reading what each agent was told")
    remarks: list[str] = []
    elsewhere = Elsewhere(flight)
    remarks += elsewhere.problems
    mission, headers = told(flight, elsewhere, name, remarks)
    rehearsals: dict[int, Rehearsal] = {}
    why: dict[int, str] = {}
    by_captures: list[int] = []
    for agent_id, header in headers.items():
        tell(f"agent {agent_id} alone")
        if header.settings != mission.settings:
            why[agent_id] = "was set otherwise than the others, and a scenario has one set of settings"
            continue
        rehearsal = _rehearsed(flight, elsewhere, header, remarks, why, by_captures)
        if rehearsal is not None and (rehearsal.played or rehearsal.parting is None):
            rehearsals[agent_id] = rehearsal
    if not rehearsals:
        first = next((f"agent {agent_id} {words}; " for agent_id, words in why.items()), "")
        raise FieldError(first + NOTHING)
    if by_captures:
        which = agents(by_captures)
        remarks.append(f"what reached {which} is from captures and blocks, and when timers ended there is inferred")
    tell("putting everything in order")
    table = timetable(rehearsals)
    lost = {agent_id for agent_id in rehearsals if flight.exports and agent_id not in flight.exports}
    if lost:
        remarks.append(f"no export of {agents(lost)}: taken to have been lost with the end of the trace")
    document = scenario_of(mission, table, rehearsals, lost)
    tell("flying it again")
    simulated = simulate_in_memory(InMemory(tracing=True), parse(document), SEED)
    difference = first_difference(table, rehearsals, simulated)
    _compare_chains(flight, rehearsals, simulated, why)
    came_home = sorted({*flight.traces, *flight.exports})
    for agent_id in came_home:
        if agent_id not in rehearsals and agent_id not in why:
            why[agent_id] = "has left no trace, and what reached it is not on record"
    if absent := set(mission.roster) - set(rehearsals):
        remarks.append(f"{agents(absent)} not played: what others heard of them is put on the air as they heard it")
    remarks += table.impossible
    remarks += _clocks_in_words(table)
    outcomes = [AgentOutcome(agent_id, _blocks(simulated, agent_id), why.get(agent_id)) for agent_id in came_home]
    document["expect"] = _expected(simulated, rehearsals)
    return Reconstruction(document, outcomes, remarks, difference, simulated, table)


def _rehearsed(
    flight: Flight,
    elsewhere: Elsewhere,
    header: CheckedHeader,
    remarks: list[str],
    why: dict[int, str],
    by_captures: list[int],
) -> Rehearsal | None:
    """The agent alone, by its trace; or, if that does not lead to its export, by its capture if that does."""
    agent_id = header.agent_id
    by_trace: Rehearsal | None = None
    if agent_id in flight.traces:
        try:
            by_trace = _by_trace(flight, elsewhere, header, remarks)
        except UnusableInputError as error:
            why[agent_id] = f"cannot be played by its trace: {error}"
    if by_trace is not None and by_trace.parting:
        why[agent_id] = _parted(flight, agent_id, by_trace)
        return by_trace
    home = flight.exports.get(agent_id)
    captured = elsewhere.captured.get(agent_id)
    if captured is None or home is None or (by_trace and by_trace.chain == list(home.chain_of_block_hashes)):
        return by_trace
    inferred = infer(header, captured, elsewhere.events(agent_id))
    by_capture = rehearse(header, inferred.lives)
    if by_trace is not None and len(by_trace.played) > len(by_capture.played):
        return by_trace
    why.pop(agent_id, None)
    if inferred.problem:
        why[agent_id] = inferred.problem
        by_capture.broken_off = True
    by_captures.append(agent_id)
    return by_capture


def _by_trace(flight: Flight, elsewhere: Elsewhere, header: CheckedHeader, remarks: list[str]) -> Rehearsal:
    """Raises UnusableInputError."""
    lives = lives_of(flight.traces[header.agent_id], header, elsewhere)
    rehearsal = rehearse(header, lives)
    if rehearsal.parting is None:
        if not rehearsal.to_the_word and (words := _judged(flight, header.agent_id)):
            remarks.append(f"agent {header.agent_id} is wrong to no effect: {words}")
        return rehearsal
    explained = _with_a_quirk(header, lives, rehearsal.parting, remarks) or _with_what_is_not_right(
        header, lives, remarks
    )
    return explained or rehearsal


def _with_a_quirk(header: CheckedHeader, lives: Lives, at: Parting, remarks: list[str]) -> Rehearsal | None:
    """The rehearsal with a known mistake that explains the whole record, if possible to the word.

    Those of the handlers are tried first that ran where the agent parts from the protocol.
    """
    explaining: dict[str, Rehearsal] = {}
    certain = (quirk for quirk in QUIRKS.values() if not quirk.chance)
    for quirk in sorted(certain, key=lambda quirk: at.algorithms.isdisjoint(quirk.algorithms)):
        rehearsal = rehearse(header, lives, {quirk.name: True})
        if rehearsal.parting is None:
            explaining[quirk.name] = rehearsal
            if rehearsal.to_the_word:
                break
    if not explaining:
        return None
    name = max(explaining, key=lambda name: explaining[name].to_the_word)
    remarks.append(f"agent {header.agent_id} behaves as with {name}: {QUIRKS[name].sentence}")
    return explaining[name]


def _with_what_is_not_right(header: CheckedHeader, lives: Lives, remarks: list[str]) -> Rehearsal | None:
    """The rehearsal of an agent whose mistakes a scenario can do without: its chain comes out all the same."""
    ignoring = rehearse(header, lives, allowed=Allowed(ignoring=True))
    if ignoring.parting is None:
        first = ignoring.ignored[0]
        many = f"{len(ignoring.ignored)} messages" if len(ignoring.ignored) > 1 else "a message"
        remarks.append(
            f"agent {header.agent_id} did nothing with {many} with which it should have done something, "
            f"the first on trace line {first.line} ({first.runs[0].handler}): lost on their way here"
        )
        return ignoring
    early = rehearse(header, lives, allowed=Allowed(early_timers=True))
    if early.parting is None:
        remarks.append(f"agent {header.agent_id} had timers end too early by its clock, as if that had been set back")
        return early
    return None


def _parted(flight: Flight, agent_id: int, rehearsal: Rehearsal) -> str:
    """Why the agent cannot be played any further."""
    assert rehearsal.parting is not None, "it has parted"
    parting = rehearsal.parting
    words = _judged(flight, agent_id) or f"trace line {parting.line}, t={parting.at_s:g} s: it {parting.what}"
    return f"does not do what the protocol says, and is played up to trace line {parting.line}: {words}"


def _judged(flight: Flight, agent_id: int) -> str | None:
    """The first step of the agent that the step judge finds wrong, in its words; None if it finds none."""
    judgement = steps.check(Evidence(flight.exports, {agent_id: flight.traces[agent_id]}))
    return next((finding.detail for finding in judgement.evidence if finding.agent_id == agent_id), None)


def _compare_chains(
    flight: Flight, rehearsals: Mapping[int, Rehearsal], simulated: Simulated, why: dict[int, str]
) -> None:
    for agent_id, rehearsal in rehearsals.items():
        if agent_id in why:
            continue
        played: Export | None = simulated.evidence.exports.get(agent_id)
        chain = list(played.chain_of_block_hashes) if played else None
        home = flight.exports.get(agent_id)
        if chain != rehearsal.chain:
            why[agent_id] = "ends with another chain in virtual time than by its trace"
        elif home is not None and list(home.chain_of_block_hashes) != chain:
            why[agent_id] = _export_differs(home, rehearsal, flight)


def _export_differs(home: Export, rehearsal: Rehearsal, flight: Flight) -> str:
    trace = flight.traces[home.agent_id]
    last_s = trace.runs[-1].t if trace.runs else 0.0
    return (
        f"is played up to the end of its trace at t={last_s:g} s, with {len(rehearsal.chain)} blocks in its chain: "
        f"its export has {len(home.chain)}, and how it came to those is not on record"
    )


def _clocks_in_words(table: Timetable) -> Iterator[str]:
    for agent_id, line in sorted(table.clocks.items()):
        drift = (line.rate - 1) * MICROSECONDS
        if abs(line.offset_s) >= 0.1 or abs(drift) >= 1:
            yield f"agent {agent_id}'s clock was {line.offset_s:+.3f} s off, and drifted by {drift:+.0f} ppm"


def _blocks(simulated: Simulated, agent_id: int) -> int:
    export = simulated.evidence.exports.get(agent_id)
    return len(export.chain) if export else 0


def _expected(simulated: Simulated, rehearsals: Mapping[int, Rehearsal]) -> Document:
    """What this run comes to: its chains, and the verdicts that are bad, which are what happened."""
    exports = simulated.evidence.exports
    chains = {str(agent): exports[agent].top_chain_hash for agent in sorted(rehearsals) if agent in exports}
    bad = {key: simulated.result.judgements[key].verdict for key in simulated.result.bad}
    characteristics = {key: verdict for key, verdict in bad.items() if key.isdecimal()}
    beside = {key: verdict for key, verdict in bad.items() if not key.isdecimal()}
    return {**({"characteristics": characteristics} if characteristics else {}), **beside, "chains": chains}
