"""Compare a trace with the reference implementation. Find the parts of the trace whose inputs can be simulated."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from harness.checker.recorded_inputs import stored_blocks
from harness.checker.steps.deviation import StepDeviation
from harness.field.ingest import Flight
from harness.field.reconstruct._agent_inputs import BootedFromDisk, KnownState, RecordedInput
from harness.field.replay import RecordedTrace, RecordPlayer
from harness.field.replay._record_search import IngestedRecords
from harness.field.replay.replay_names import ReplayNames
from ucp.block import Block
from ucp.trace import HandlerRun


class JudgedTrace:
    """The trace of an agent, compared with the reference implementation.

    `deviations` contains the differences from the reference. `lost` contains the reasons why parts of the trace could
    not be judged.
    """

    def __init__(self, flight: Flight, agent_id: int) -> None:
        """Compare the trace with the reference implementation. Raises FieldError if the trace does not
        contain inputs.
        """
        trace = flight.traces[agent_id]
        record = RecordedTrace(Path(f"agent {agent_id}"), "", trace, IngestedRecords(flight), [])
        player = RecordPlayer(record)
        self._known: dict[int, KnownState] = {}
        """The state of the agent after each handler run at which the state becomes known again. The key is the Python
        object ID of the handler run.
        """
        self._played: set[int] = set()
        """The Python object IDs of the handler runs that the reference could execute."""
        self._names = ReplayNames(record)
        self._export = flight.exports.get(agent_id)
        self._is_last_line_lost = False
        while not player.at_end:
            entry = player.forward()
            if not isinstance(entry.content, HandlerRun):
                continue
            self._is_last_line_lost = player.lost is not None
            if player.lost is None and player.resumed_at == player.position:
                chain, current_block = tuple(player.state.chain), bytes(player.state.current_block) or None
                self._known[id(entry.content)] = KnownState(chain, current_block, player.result.lost[-1])
            elif player.lost is None:
                self._played.add(id(entry.content))
        result = player.to_end()
        self.deviations: list[StepDeviation] = result.deviations
        self.lost: list[str] = result.lost

    @property
    def first_finding(self) -> str | None:
        """A sentence about the first deviation from the reference implementation, or None if there is no deviation."""
        return self.deviations[0].sentence(self._names.of) if self.deviations else None

    def with_known_states(
        self, incarnations: Sequence[Sequence[RecordedInput]]
    ) -> list[list[RecordedInput | KnownState]]:
        """Return the inputs that can be simulated. Where inputs are lost, the result contains the known state of the
        agent after the lost inputs.
        """
        parts = [[*self._parts(inputs)] for inputs in incarnations]
        for before, after in zip(parts, incarnations[1:], strict=False):
            if after and isinstance(after[0].cause, BootedFromDisk) and (disk := _disk(after[0])) is not None:
                before.append(disk)
        if (last := self._state_at_export()) is not None:
            parts[-1].append(last)
        return parts

    def _parts(self, inputs: Sequence[RecordedInput]) -> Iterator[RecordedInput | KnownState]:
        for number, recorded in enumerate(inputs):
            if id(recorded.runs[0]) in self._played:
                kept = [run for run in recorded.runs if id(run) in self._played]
                is_last = number + 1 == len(inputs) or id(inputs[number + 1].runs[0]) not in self._played
                is_partial = is_last or len(kept) < len(recorded.runs)
                yield RecordedInput(recorded.at_s, recorded.line, recorded.cause, kept, is_partial)
            yield from (self._known[id(run)] for run in recorded.runs if id(run) in self._known)

    def _state_at_export(self) -> KnownState | None:
        """Return the state in the agent's export, which is the known state at the end of its trace. Return None if the
        agent was not idle when it exported its chain.
        """
        export = self._export
        if export is None or not export.idle or export.blocks_to_be_committed or export.reconcile_stack:
            return None
        chain = tuple(Block(block.agent_id, block.timestamp_us, block.event_bytes) for block in export.chain)
        why = self.lost[-1] if self._is_last_line_lost else "the trace ends before the export"
        return KnownState(chain, None, why)


def _disk(boot: RecordedInput) -> KnownState | None:
    """Return the recorded content of the disk at a restart. Return None if the disk contained blocks that were not in
    the chain.
    """
    run = boot.runs[0]
    try:
        blocks = [*stored_blocks(run.input)]
    except ValueError:
        return None
    placed = [operation for operation, _ in run.changes if operation in ("chain+", "deque+", "stack+")]
    if placed[: len(blocks)] != ["chain+"] * len(blocks):
        return None
    return KnownState(tuple(blocks), None, "the lines before a boot are lost")
