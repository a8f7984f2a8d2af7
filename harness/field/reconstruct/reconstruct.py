"""Reconstruct a flight as a scenario, write the scenario to a file, and verify that it reproduces the flight."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

from harness.archive.archive import ReportProgress
from harness.archive.exports import Export
from harness.checker.judgement import agents
from harness.checker.signatures import TrustedKeys, vouch
from harness.errors import FieldError, MachineError
from harness.field.ingest import Flight
from harness.field.reconstruct._comparing import FirstDifference, SoloSimulations, first_difference
from harness.field.reconstruct._known_mission import NO_INPUTS, OtherRecords, known_mission
from harness.field.reconstruct._rehearsal import SoloSimulation
from harness.field.reconstruct._timetable import InputTimetable, timetable
from harness.field.reconstruct._timetable_script import scenario_document
from harness.run.simulate import MemoryRecorder, Simulated, simulate_in_memory
from harness.scenario.load import parse
from harness.scenario.scenario_file import Document, to_yaml
from ucp.clock import MICROSECONDS

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.opening import DatagramOpener
    from ucp.secure.sealing import Depot

SEED = 1
"""The seed of the simulation. The scenario does not depend on the seed."""


@dataclass(frozen=True)
class AgentOutcome:
    """The result of the reconstruction for one agent."""

    agent_id: int
    blocks: int
    """The number of blocks in the agent's simulated chain."""
    why: str | None = None
    """The reason why the simulated chain differs from the recorded chain, or None if both are equal."""


@dataclass
class Reconstruction:
    """A scenario and the part of the flight that it reproduces."""

    document: Document
    agents: list[AgentOutcome]
    """The results for the agents that have a record."""
    remarks: list[str]
    """Sentences about the assumptions."""
    difference: FirstDifference | None
    """The first step at which the simulation differs from a record that should be simulated completely."""
    simulated: Simulated
    table: InputTimetable = field(repr=False)
    wrong_signatures: list[str] = field(default_factory=list)
    """A sentence about each wrong signature in the exports of a secured flight."""

    @property
    def problems(self) -> list[str]:
        """Sentences about the parts of the flight that are not reproduced. The sentence about the first difference is
        first.
        """
        first = [self.difference.sentence] if self.difference else []
        return first + [f"agent {agent.agent_id} {agent.why}" for agent in self.agents if agent.why]

    @property
    def blocks(self) -> int:
        """The number of different blocks in the reproduced chains."""
        exports = self.simulated.evidence.exports
        chains = (exports[agent].chain_of_block_hashes for agent in self.reproduced if agent in exports)
        return len({block for chain in chains for block in chain})

    @property
    def reproduced(self) -> list[int]:
        return [agent.agent_id for agent in self.agents if agent.why is None]

    @property
    def sentence(self) -> str:
        """The result of the reconstruction in one sentence."""
        reproduced, all_of_them = len(self.reproduced), len(self.agents)
        if not self.problems:
            chains = "the chain" if reproduced == 1 else f"all {reproduced} chains"
            return f"reproduces {chains}, {self.blocks} blocks"
        return f"reproduces {reproduced} of {all_of_them} chains: {self.problems[0]}"

    def to_json(self) -> dict[str, object]:
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
            "wrong_signatures": self.wrong_signatures,
            "remarks": self.remarks,
        }


def reconstruct(
    flight: Flight,
    name: str,
    report_progress: ReportProgress = lambda sentence: None,
    *,
    opener: "DatagramOpener | None" = None,
    depot: "Depot | None" = None,
    keys: "PublicKeys | None" = None,
) -> Reconstruction:
    """Reconstruct a flight. `report_progress` is called with a text at each step. Raises FieldError if no record is
    usable.

    In a secured mission, `opener` decrypts captures, `depot` decrypts blocks, and `keys` are public keys that the user
    trusts.
    """
    report_progress("reading the inputs of each agent")
    remarks: list[str] = []
    other_records = OtherRecords(flight, opener, depot)
    mission, headers = known_mission(flight, other_records, name, remarks)
    solo = SoloSimulations(flight, other_records)
    rehearsals, why = solo.rehearsals, solo.why
    for agent_id, header in headers.items():
        report_progress(f"agent {agent_id} alone")
        if header.settings == mission.settings:
            solo.rehearse(header)
        else:
            why[agent_id] = "has other settings than the other agents, and a scenario has one set of settings"
    remarks += dict.fromkeys(other_records.problems)
    if any(header.secured for header in headers.values()):
        remarks.append(
            "the flight was secured and is reproduced without keys: datagrams that agents dropped as not "
            "authentic are left out"
        )
    remarks += solo.remarks
    if not any(rehearsal.played for rehearsal in rehearsals.values()):
        first = next((f"agent {agent_id} {words}; " for agent_id, words in why.items()), "")
        raise FieldError(first + NO_INPUTS)
    wrong_signatures = _check_signatures(flight, keys, remarks)
    report_progress("ordering the inputs")
    ahead_s = {
        match.agent_id: match.clock_ahead_s
        for match in flight.flight_logs
        if match.agent_id is not None and match.clock_ahead_s is not None
    }
    table = timetable(rehearsals, ahead_s)
    lost = {agent_id for agent_id in rehearsals if flight.exports and agent_id not in flight.exports}
    if lost:
        remarks.append(f"no export of {agents(lost)}: the vehicle counts as lost at the end of its trace")
    document = scenario_document(mission, table, rehearsals, lost, other_records.sealed)
    report_progress("playing the scenario")
    simulated = simulate_in_memory(MemoryRecorder(tracing=True), parse(document), SEED)
    difference = first_difference(table, rehearsals, simulated)
    _compare_chains(flight, rehearsals, simulated, why)
    recorded_agents = sorted({*flight.traces, *flight.exports})
    for agent_id in recorded_agents:
        if agent_id not in rehearsals and agent_id not in why:
            why[agent_id] = "has no trace, and its inputs are not recorded"
    if absent := set(mission.roster) - set(rehearsals):
        remarks.append(
            f"{agents(absent)} not played: the scenario sends the messages that other agents received from them"
        )
    remarks += table.contradictions
    remarks += _clocks_in_words(table)
    outcomes = [AgentOutcome(agent_id, _blocks(simulated, agent_id), why.get(agent_id)) for agent_id in recorded_agents]
    document["expect"] = _expected(simulated, {*rehearsals} - {*why})
    return Reconstruction(document, outcomes, remarks, difference, simulated, table, wrong_signatures)


def _check_signatures(flight: Flight, keys: "PublicKeys | None", remarks: list[str]) -> list[str]:
    """Return a sentence about each wrong signature. If signatures do not confirm the exports, add a remark."""
    trusted = TrustedKeys(keys, "--keys") if keys is not None else None
    if trusted is None and flight.public_keys is not None:
        trusted = TrustedKeys(flight.public_keys, None)
    wrong, doubt = vouch(flight.exports.values(), trusted)
    if doubt is not None:
        remarks.append(doubt)
    return wrong


def _compare_chains(
    flight: Flight, rehearsals: Mapping[int, SoloSimulation], simulated: Simulated, why: dict[int, str]
) -> None:
    for agent_id, rehearsal in rehearsals.items():
        if agent_id in why:
            continue
        played: Export | None = simulated.evidence.exports.get(agent_id)
        chain = list(played.chain_of_block_hashes) if played else None
        export = flight.exports.get(agent_id)
        if chain != rehearsal.chain:
            why[agent_id] = "ends with another chain in virtual time than in its trace"
        elif export is not None and list(export.chain_of_block_hashes) != chain:
            why[agent_id] = _export_differs(export, rehearsal, flight)


def _export_differs(export: Export, rehearsal: SoloSimulation, flight: Flight) -> str:
    trace = flight.traces.get(export.agent_id)
    if trace is None:
        return f"has another chain in its export ({len(export.chain)} blocks) than its recorded inputs lead to"
    last_s = trace.runs[-1].t if trace.runs else 0.0
    return (
        f"is played up to the end of its trace at t={last_s:g} s, with {len(rehearsal.chain)} blocks in its chain; "
        f"its export has {len(export.chain)}, and the inputs between are not recorded"
    )


def _clocks_in_words(table: InputTimetable) -> Iterator[str]:
    for agent_id, line in sorted(table.clocks.items()):
        drift = (line.rate - 1) * MICROSECONDS
        if abs(line.offset_s) >= 0.1 or abs(drift) >= 1:
            yield f"agent {agent_id}'s clock was {line.offset_s:+.3f} s off, and drifted by {drift:+.0f} ppm"


def _blocks(simulated: Simulated, agent_id: int) -> int:
    export = simulated.evidence.exports.get(agent_id)
    return len(export.chain) if export else 0


def _expected(simulated: Simulated, reproduced: set[int]) -> Document:
    """Return the section `expect` of the scenario: the reproduced chains, and the bad verdicts on the recorded
    flight.
    """
    exports = simulated.evidence.exports
    chains = {str(agent): exports[agent].top_chain_hash for agent in sorted(reproduced) if agent in exports}
    bad = {key: simulated.result.judgements[key].verdict for key in simulated.result.bad}
    characteristics = {key: verdict for key, verdict in bad.items() if key.isdecimal()}
    further = {key: verdict for key, verdict in bad.items() if not key.isdecimal()}
    expected: Document = {"characteristics": characteristics} if characteristics else {}
    return {**expected, **further, **({"chains": chains} if chains else {})}


WIDTH = 116


def write(reconstruction: Reconstruction, path: Path, sources: Sequence[Path], left_out: Sequence[str]) -> None:
    """Write the reconstructed scenario to a file. Raises MachineError if that fails."""
    sentences = _sentences(reconstruction, path, sources, left_out)
    comment = [line for sentence in sentences for line in wrap(sentence, WIDTH)]
    try:
        path.write_text(to_yaml(reconstruction.document, comment), encoding="utf-8")
    except OSError as error:
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


def _sentences(
    reconstruction: Reconstruction, path: Path, sources: Sequence[Path], left_out: Sequence[str]
) -> Iterator[str]:
    yield f"Made by `ucp-harness reconstruct` from {', '.join(map(str, sources))}: it {reconstruction.sentence}."
    yield from (f"- {problem}" for problem in reconstruction.problems[1:])
    yield from (f"- {remark}" for remark in reconstruction.remarks)
    yield from (f"- not used: {sentence}" for sentence in left_out)
    yield "Agents receive only the messages of `fates` and `datagrams`; messages without effect are left out."
    yield (
        "`expect` is the recorded result, with the reproduced chains only. If it shows a mistake that is fixed now, "
        "write the correct result instead."
    )
    yield f"  ucp-harness run {path} --backend sim --seed {SEED}"
    yield f"  pytest {path}"
