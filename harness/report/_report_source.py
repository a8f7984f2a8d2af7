"""Read the input of a report: the files of a run, a colour for each agent, and a sentence about each missing or damaged
file.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.connectivity import Connectivity
from harness.archive.exports import Exports
from harness.archive.record_file import DamagedRecordError
from harness.archive.run_record import RunRecord
from harness.archive.traces import Trace
from harness.errors import RunDirectoryError
from harness.present.colours import AgentColours
from harness.report import _swarm_section, facts


@dataclass(frozen=True)
class ReportSource:
    """The input of a report. The function `read_source` creates it."""

    archive: RunArchive
    run_dir: Path
    ink: dict[int, AgentColours]

    @property
    def record(self) -> RunRecord:
        return self.archive.record

    @property
    def exports(self) -> Exports:
        return self.archive.exports

    @cached_property
    def traces(self) -> dict[int, Trace]:
        """The trace of each agent, by agent ID. From large traces, the reader omits handler runs that only received a
        message.
        """
        traces = self.archive.traces
        return {agent: trace.skimmed() for agent, trace in traces.items()} if self.archive.large else traces

    @cached_property
    def network(self) -> Connectivity:
        return self.archive.network(self.ink)

    @cached_property
    def chains(self) -> dict[int, tuple[str, ...]]:
        """The block hashes of each agent's chain."""
        return {agent_id: export.chain_of_block_hashes for agent_id, export in self.exports.by_agent.items()}

    @property
    def top_chain_hashes(self) -> dict[int, str]:
        return {agent_id: export.top_chain_hash for agent_id, export in self.exports.by_agent.items()}

    @property
    def unmet_expectations(self) -> list[str]:
        """Sentences about results that the scenario expects but the run did not show. Sentences about expected verdicts
        are not included.
        """
        if not self.record.characteristics:
            return []
        kinds = self.record.unmet_expectations(self.chains, self.top_chain_hashes)
        return [sentence for _, unmet in kinds for sentence in unmet]

    @property
    def chains_missing(self) -> list[str]:
        """Sentences about agents whose chain export is missing or unusable, and about damaged exports."""
        return [*_swarm_section.missing(self.archive), *map(self.archive.within, self.exports.errors)]

    @property
    def files_missing(self) -> list[str]:
        """Sentences about missing or damaged files. Chain exports are not included, because `chains_missing` describes
        them.
        """
        exports = set(self.exports.errors)
        problems = [*(problem for problem in self.archive.problems if problem not in exports), *self.archive.gaps]
        return [
            *map(self.archive.within, problems),
            *self.network.problems,
            *filter(None, [facts.gaps(self.record.capture or {})]),
        ]


def read_source(archive: RunArchive) -> ReportSource:
    """Return the input of a report from the archive of a run.

    Raises RunDirectoryError if the directory holds no run, or a run of another version.
    """
    error, directory = archive.record_error, archive.directory
    if directory is None or not (archive.recorded or archive.roster):
        raise error or RunDirectoryError(f"{directory}: no files of a run found; is this a run directory?")
    if error is not None and not isinstance(error, DamagedRecordError):
        raise error
    return ReportSource(archive, directory, _swarm_section.agent_inks(archive))
