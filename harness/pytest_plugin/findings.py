"""Provide the verdicts and numeric results of a run for tests."""

from dataclasses import dataclass
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.exports import name_blocks
from harness.checker import Result
from harness.checker.judgement import Finding, Judgement
from harness.errors import ScenarioError
from harness.scenario.verdict_names import FURTHER_CHECKS, Verdict, kind_of

EVIDENCE_SHOWN = 5


@dataclass(frozen=True, repr=False)
class JudgementInTest:
    """A verdict with its number or key. A failing `assert` shows the verdict together with its reason."""

    key: str
    name: str
    verdict: Verdict
    reason: str
    evidence: list[Finding]

    @classmethod
    def of(cls, key: str, judgement: Judgement) -> "JudgementInTest":
        return cls(key, judgement.name, judgement.verdict, judgement.reason, judgement.evidence)

    @property
    def title(self) -> str:
        """The title of the check, such as "characteristic 6, one uniform chain" or "steps"."""
        return self.key if self.key in FURTHER_CHECKS else f"characteristic {self.key}, {self.name}"

    @property
    def holds(self) -> bool:
        """True if the verdict is `holds`, `as specified`, `agree` or `finished`."""
        return kind_of(self.verdict) == "good"

    def __repr__(self) -> str:
        return f"<{self.title}: {self.verdict}: {self.reason}>"

    def lines(self) -> list[str]:
        """Return the verdict as one line of text, followed by its evidence."""
        lines = [f"{self.title}: {self.verdict}: {self.reason}"]
        lines += [f"    agent {finding.agent_id}: {finding.detail}" for finding in self.evidence[:EVIDENCE_SHOWN]]
        if len(self.evidence) > EVIDENCE_SHOWN:
            lines.append(f"    and {len(self.evidence) - EVIDENCE_SHOWN} more in the report")
        return lines


@dataclass(frozen=True, repr=False)
class Findings:
    """The value of the fixture `scenario`: the directory and the verdicts of a run."""

    directory: Path
    result: Result

    def __repr__(self) -> str:
        return f"<run in {self.directory}>"

    def characteristic(self, number: int) -> JudgementInTest:
        """Return the verdict on a characteristic. Raises ScenarioError for a number that is not 1 to 6."""
        __tracebackhide__ = True
        characteristic = self.result.characteristics.get(str(number))
        if characteristic is None:
            raise ScenarioError(f"no characteristic {number!r}: use 1 to 6")
        return JudgementInTest.of(str(number), characteristic)

    def judgement(self, key: str) -> JudgementInTest:
        """Return the verdict on `steps`, `records` or `liveness`. Raises ScenarioError for any other key."""
        __tracebackhide__ = True
        judgement = self.result.beside.get(key)
        if judgement is None:
            raise ScenarioError(f"no judgement {key!r}: use one of {', '.join(FURTHER_CHECKS)}")
        return JudgementInTest.of(key, judgement)

    @property
    def figures(self) -> dict[str, float | int | None]:
        """The numeric results in run.json, such as `mutual_chain`, `distinct_chains` and `reconciles`."""
        return self.result.figures

    def chain(self, agent: int) -> list[str]:
        """Return the names of the blocks in the agent's chain, such as "4.11". The oldest block is first.

        Raises ScenarioError if no chain of the agent is available.
        """
        __tracebackhide__ = True
        exports = RunArchive(self.directory).exports.by_agent
        if agent not in exports:
            raise ScenarioError(f"no chain of agent {agent!r}; agents with a chain: {sorted(exports)}")
        names = name_blocks(exports)
        return [names[block_hash] for block_hash in exports[agent].chain_of_block_hashes]

    @property
    def report(self) -> Path:
        """The path of the report. After the test, the report exists if the test failed, or if `--ucp-keep` is set."""
        return self.directory / "report.html"
