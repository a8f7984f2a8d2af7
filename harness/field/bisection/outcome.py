"""Define the subject of a bisection (a scenario or records), the result of one run or replay of the subject, and the
differences between two results.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE, Export, name_blocks
from harness.checker import Result
from harness.errors import RunDirectoryError, ScenarioError
from harness.scenario import Scenario, load, load_scenario
from harness.scenario.load import MAX_SCENARIO_BYTES
from harness.scenario.verdict_names import BAD_IN_WORDS, kind_of
from ucp.plain_file import read_json, read_plain_file

MAX_OUTCOME_BYTES = 64 * 1024 * 1024
TIMING_DEPENDENT = ("2", "5", "6", "liveness")
"""Keys of the judgements that depend on timing. Their results depend on the progress of the agent processes at the end
of the run.
"""


class _OutcomeModel(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class RecordDifference(_OutcomeModel):
    """A difference between the behaviour of an agent core and a record."""

    line: int
    handler: str | None
    detail: str


class AgentResult(_OutcomeModel):
    """The result of one agent. A field is None if it is not compared. `chain` contains the names of the agent's blocks,
    oldest first, and `top` is the top chain hash. `deviates` is the name of the handler in which the agent first
    deviates from the protocol, or "" without such a handler. `differences` contains the differences from the agent's
    record.
    """

    chain: list[str] | None = None
    top: str | None = None
    deviates: str | None = None
    differences: list[RecordDifference] | None = None


class Outcome(_OutcomeModel):
    """The outcome of one run of a scenario, or of one replay of records."""

    schema_: Literal["ucp-outcome/1"] = "ucp-outcome/1"
    subject: str
    agents: dict[int, AgentResult] = {}
    verdicts: dict[str, str] = {}
    crashed: str | None = None
    """The place of the exception that ended the tested code, or None if there was no exception."""

    def as_recorded(self) -> "Outcome":
        """Return this outcome without its differences from the records and without a crash. A core that behaves exactly
        as recorded would have this outcome.
        """
        agents = {agent: AgentResult(differences=[]) for agent in self.agents}
        return self.model_copy(update={"agents": agents, "crashed": None})

    @property
    def sentence(self) -> str:
        """The outcome in one line of text."""
        if self.crashed:
            return f"it crashes: {self.crashed}"
        bad = [key for key, verdict in self.verdicts.items() if kind_of(verdict) == "bad"]
        wrong = [
            f"agent {agent} in {result.deviates or 'no handler'}"
            for agent, result in self.agents.items()
            if result.deviates
        ]
        chains = {result.top: result.chain for result in self.agents.values() if result.chain is not None}
        phrases = [f"{len(chains)} distinct chain{'s' if len(chains) != 1 else ''}"] if chains else []
        for agent, result in self.agents.items():
            if result.differences:
                phrases.append(
                    f"agent {agent}: {len(result.differences)} differences, the first at line {_first(result)}"
                )
            elif result.differences is not None:
                phrases.append(f"agent {agent}: as recorded")
        return "; ".join([*phrases, *(BAD_IN_WORDS.get(key, key) for key in bad), *wrong]) or "nothing differs"


def _first(result: AgentResult) -> str:
    first = (result.differences or [])[0]
    return f"{first.line}{f', in {first.handler}' if first.handler else ''}"


def outcome_of_run(subject: str, result: Result, exports: dict[int, Export], *, exact: bool) -> Outcome:
    """Return the outcome of a run that the checker has judged.

    If the run is not `exact`, because its processes depend on timing, the outcome omits chains and timing-dependent
    judgements.
    """
    names = name_blocks(exports)
    first: dict[int, str] = {}
    for finding in result.beside["steps"].evidence:
        first.setdefault(finding.agent_id, finding.handler or "")
    agents = {}
    for agent, export in sorted(exports.items()):
        chain = [names.get(block, block[:12]) for block in export.chain_of_block_hashes] if exact else None
        top = export.top_chain_hash if exact else None
        agents[agent] = AgentResult(chain=chain, top=top, deviates=first.get(agent))
    judged = result.judgements.items()
    verdicts: dict[str, str] = {
        key: judgement.verdict for key, judgement in judged if exact or key not in TIMING_DEPENDENT
    }
    return Outcome(subject=subject, agents=agents, verdicts=verdicts)


def differences(before: Outcome, after: Outcome) -> list[str]:
    """Return a sentence for each difference between two outcomes."""
    return list(_differences(before, after))


def _differences(before: Outcome, after: Outcome) -> Iterator[str]:
    if before.crashed != after.crashed:
        yield f"it crashes: {after.crashed}" if after.crashed else f"it no longer crashes ({before.crashed})"
        return
    for key in {**before.verdicts, **after.verdicts}:
        if (was := before.verdicts.get(key)) != (now := after.verdicts.get(key)):
            what = f"characteristic {key}" if key.isdecimal() else key
            yield f"{what}: {now or 'not judged'}, was {was or 'not judged'}"
    for agent in sorted({*before.agents, *after.agents}):
        was_result, now_result = before.agents.get(agent, AgentResult()), after.agents.get(agent, AgentResult())
        yield from (f"agent {agent}: {labels}" for labels in _agent_differences(was_result, now_result))


def _agent_differences(was: AgentResult, now: AgentResult) -> Iterator[str]:
    if was.deviates != now.deviates:
        labels = {None: "nowhere", "": "in no known handler"}
        yield (
            f"its first deviation is {labels.get(now.deviates, f'in {now.deviates}')}, was "
            f"{labels.get(was.deviates, f'in {was.deviates}')}"
        )
    if was.top != now.top:
        old, new = was.chain or [], now.chain or []
        shared = next((place for place, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1]), None)
        if shared is None:
            shared = min(len(old), len(new))
        yield (
            f"its chain has {len(new)} blocks, was {len(old)}; block {shared + 1} is "
            f"{_at(new, shared)}, was {_at(old, shared)}"
        )
    if was.differences != now.differences:
        old_differences, new_differences = was.differences or [], now.differences or []
        known = {(each.line, each.handler, each.detail) for each in old_differences}
        new_ones = [each for each in new_differences if (each.line, each.handler, each.detail) not in known]
        if new_ones:
            first = new_ones[0]
            yield f"line {first.line}{f', {first.handler}' if first.handler else ''}: {first.detail}"
        else:
            gone = len(old_differences) - len(new_differences)
            yield f"{gone} differences from the record have disappeared"


def _at(chain: list[str], place: int) -> str:
    return chain[place] if place < len(chain) else "not there"


def read(path: Path) -> Outcome:
    """Read an outcome from a file. Raises RunDirectoryError."""
    try:
        return Outcome.model_validate(read_json(path, MAX_OUTCOME_BYTES))
    except OSError as error:
        raise RunDirectoryError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        raise RunDirectoryError(f"{path}: not an outcome; `ucp-harness bisect --once ... --out` writes one") from None


YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class BisectionSubject:
    """The subject of a bisection. If `scenario` is None, the subject is the records in `path`, and `agent` selects the
    records of one agent.
    """

    path: Path
    scenario: Scenario | None
    seed: int
    agent: int | None = None

    @property
    def in_words(self) -> str:
        if self.scenario is None:
            return (
                f"the records in {self.path}" if self.agent is None else f"agent {self.agent}'s record in {self.path}"
            )
        return f"{self.path}, seed {self.seed}"


def subject_of(path: Path, seed: int | None, agent: int | None) -> BisectionSubject:
    """Return the scenario or records at `path`, which are the subject of the bisection.

    A YAML file, the name of an included scenario, and a run directory of virtual time are scenarios. Every other path
    contains records. Raises HarnessError.
    """
    path = load.find_file(path)
    if path.suffix in YAML or (path.is_file() and _is_scenario(path)):
        scenario = load_scenario(path)
        own = scenario.expect.seeds[0] if scenario.expect else 1
        subject = BisectionSubject(path.resolve(), scenario, own if seed is None else seed)
    elif (path / RUN_FILE).is_file() and agent is None and (played := _played(path)) is not None:
        subject = BisectionSubject(path.resolve(), played[0], played[1] if seed is None else seed)
    else:
        if not path.exists():
            raise ScenarioError(f"{path}: no such file, directory or scenario")
        subject = BisectionSubject(path.resolve(), None, 0, agent)
    if subject.scenario is not None and agent is not None:
        raise ScenarioError("--agent selects a record, but the subject is a scenario: leave it out")
    return subject


def _is_scenario(path: Path) -> bool:
    try:
        return read_plain_file(path, MAX_SCENARIO_BYTES).lstrip()[:5] == b"name:"
    except OSError:
        return False


def _played(path: Path) -> tuple[Scenario, int] | None:
    """Return the scenario and the seed of a recorded run, if repeated runs with them always give the same result.
    Otherwise return None.
    """
    record = RunArchive(path).record
    if record.backend != "sim" or record.scenario is None or record.seed is None:
        return None
    return record.scenario, record.seed
