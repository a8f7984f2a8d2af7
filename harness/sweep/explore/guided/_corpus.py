"""Store scenarios and findings in a directory (corpus), so that the next night can continue with them.

corpus.json    the scenario of the corpus
runs/          a scenario for each kept run; its file name ends with the seed
findings.json  the findings, with the first and last night in which each was found
findings/      the smallest scenario of each finding
nights/        the results of each night, as JSON
report.html    the last night

The files may come from any user. A file that does not match the corpus is reported and omitted. No file can choose the
program of an agent.
"""

import fcntl
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from harness.errors import MachineError, RunDirectoryError, ScenarioError
from harness.scenario import Scenario
from harness.scenario.load import parse, read_yaml
from harness.sweep.explore._scenario_document import Document, document_of
from harness.sweep.explore.guided._hunt import MOST_KEPT, CandidateRun
from harness.sweep.explore.guided._hunt_trial import FindingIdentity, with_liveness_phase, without_liveness_phase
from harness.sweep.explore.guided._mutation import MutationLimits
from ucp.agent_files import write_atomically, write_json_atomically
from ucp.plain_file import open_plain_file, parse_json, read_plain_file

SCHEMA = "ucp-corpus/1"
MOST_BYTES = 256 * 1024
"""Maximum size of the file for a stored run, in bytes."""
MOST_FINDINGS = 500
MOST_NIGHTS = 400
MOST_STATES = 10**12
CHANGED = frozenset(
    (
        "agents",
        "duration_s",
        "network",
        "timeline",
        "schedule",
        "events",
        "settings",
        "clocks",
        "fates",
        "lateness",
        "settle",
        "final_reconcile",
        "initial_data",
        "datagrams",
        "name",
    )
)
"""Scenario keys in which a stored run may differ from the scenario of the directory. The other keys must not differ,
because some of them affect this machine. For example, they can choose the program of an agent.
"""
LONGEST_S = 3600.0
_NAME = re.compile(r"[0-9a-f]{12}-seed-(\d{1,10})\.yaml")
Text = Annotated[str, Field(max_length=500)]
NightName = Annotated[str, Field(max_length=40)]


class Finding(BaseModel):
    """A bad verdict of one kind. `first` and `last` are the start times of two nights: the first and the last one with
    a run that showed the finding.
    """

    model_config = ConfigDict(extra="ignore")

    key: Text
    verdict: Text
    handler: Text = ""
    shape: Text = ""
    seed: Annotated[int, Field(ge=0, lt=2**32)]
    first: NightName
    last: NightName
    words: Annotated[list[Text], Field(max_length=20)] = []
    """Lines of text that contain the evidence for the finding."""

    @property
    def identity(self) -> FindingIdentity:
        return FindingIdentity(self.key, self.verdict, self.handler, self.shape)

    @property
    def file(self) -> str:
        """The name of the file that contains the scenario of the finding."""
        digest = sha256(repr((self.key, self.verdict, self.handler, self.shape)).encode()).hexdigest()[:8]
        slug = re.sub(r"[^a-z0-9]+", "_", f"{self.key} {self.verdict} {self.handler}".lower()).strip("_")[:60]
        return f"{slug}_{digest}.yaml"


class _FindingsFile(BaseModel):
    model_config = ConfigDict(populate_by_name=True)

    schema_: Literal["ucp-findings/2"] = Field(default="ucp-findings/2", alias="schema")
    findings: Annotated[list[Finding], Field(max_length=MOST_FINDINGS)] = []


@dataclass
class Corpus:
    """An open corpus (a directory with stored scenarios and findings). The directory is locked against other commands.
    `left_out` contains a sentence for each file that is not used.
    """

    directory: Path
    base: Document
    limits: MutationLimits
    left_out: list[str] = field(default_factory=list)
    _lock: BinaryIO | None = None

    def close(self) -> None:
        if self._lock is not None:
            self._lock.close()

    def runs(self) -> list[CandidateRun]:
        """Return the stored runs in the order of their file names, without duplicates."""
        paths = sorted((self.directory / "runs").iterdir())
        if len(paths) > 2 * MOST_KEPT:
            self.left_out.append(f"{len(paths) - 2 * MOST_KEPT} of {len(paths)} files in {self.directory / 'runs'}")
        by_name: dict[str, CandidateRun] = {}
        for path in paths[: 2 * MOST_KEPT]:
            if (candidate := self._run(path)) is not None:
                name = _name_of(candidate)
                by_name[name] = candidate
                if path.name != name:  # copied by hand, or from an older version
                    self._rename(path, name)
        return list(by_name.values())

    def _run(self, path: Path) -> CandidateRun | None:
        name = _NAME.fullmatch(path.name)
        document = None if name is None else self._document(path)
        if name is None or document is None:
            if name is None:
                self.left_out.append(f"{path} is not a run of this corpus")
            return None
        return CandidateRun(without_liveness_phase(document), int(name[1]))

    def keep(self, candidate: CandidateRun) -> None:
        """Store a run. Raises MachineError if the file cannot be written."""
        text = json.dumps(with_liveness_phase(candidate.document), sort_keys=True)
        self._write(self.directory / "runs" / _name_of(candidate), text + "\n")

    def drop(self, candidate: CandidateRun) -> None:
        """Delete the file of a stored run that the search no longer uses."""
        (self.directory / "runs" / _name_of(candidate)).unlink(missing_ok=True)

    def findings(self) -> list[Finding]:
        """Return the stored findings."""
        path = self.directory / "findings.json"
        if not path.exists():
            return []
        try:
            return _FindingsFile.model_validate_json(self._read(path)).findings
        except (ValidationError, ValueError, RecursionError, ScenarioError):
            self.left_out.append(f"{path} is not a list of findings: earlier findings are unknown")
            return []

    def scenario_of(self, finding: Finding) -> Document | None:
        """Return the scenario of a finding. Return None if the file of the scenario is missing or invalid."""
        path = self.directory / "findings" / finding.file
        return self._document(path) if path.exists() else None

    def write_findings(self, findings: list[Finding]) -> None:
        document = _FindingsFile(findings=findings[-MOST_FINDINGS:]).model_dump(mode="json", by_alias=True)
        self._checked_write(lambda path: write_json_atomically(path, document), self.directory / "findings.json")

    def write_scenario(self, finding: Finding, text: str) -> Path:
        path = self.directory / "findings" / finding.file
        self._write(path, text)
        return path

    def write_night(self, began: str, document: dict[str, Any], page: Callable[[list[dict[str, Any]]], str]) -> Path:
        """Store the results of this night, and write the page about all nights."""
        name = re.sub("[^0-9TZ]", "", began)
        path = self.directory / "nights" / f"{name}.json"
        self._checked_write(lambda path: write_json_atomically(path, document), path)
        report = self.directory / "report.html"
        self._write(report, page(list(self._nights())))
        return report

    def _nights(self) -> Iterator[dict[str, Any]]:
        for path in sorted((self.directory / "nights").glob("*.json"))[-MOST_NIGHTS:]:
            try:
                night = parse_json(self._read(path))
                if type(night["local_states"]) is not int or not 0 <= night["local_states"] < MOST_STATES:
                    raise ValueError
            except (ValueError, KeyError, TypeError, OSError):
                self.left_out.append(f"{path} is not a night of this corpus")
                continue
            yield night

    def _document(self, path: Path) -> Document | None:
        try:
            text = read_plain_file(path, MOST_BYTES)
            document = parse_json(text) if text.startswith(b"{") else read_yaml(path, "scenario")
            return check_fits(document, self.base, self.limits)
        except (OSError, ValueError, ScenarioError) as error:
            self.left_out.append(f"{path.name} is left out: {str(error)[:200]}")
            return None

    def _rename(self, path: Path, name: str) -> None:
        def rename(path: Path) -> None:
            path.replace(path.with_name(name))

        self._checked_write(rename, path)

    def _read(self, path: Path) -> bytes:
        return read_plain_file(path, 64 * MOST_BYTES)

    def _write(self, path: Path, text: str) -> None:
        self._checked_write(lambda path: write_atomically(path, text), path)

    def _checked_write(self, write: Callable[[Path], None], path: Path) -> None:
        try:
            write(path)
        except OSError as error:
            raise MachineError(f"{path} cannot be written: {error.strerror}") from None


def opened(directory: Path, scenario: Scenario, limits: MutationLimits) -> Corpus:
    """Open a directory of stored scenarios and findings (corpus). Create it if it does not exist.

    Raises RunDirectoryError if the directory is no corpus, is the corpus of another scenario, or is in use by another
    command.
    """
    base, path = document_of(scenario), directory / "corpus.json"
    try:
        for part in ("runs", "findings", "nights"):
            if not path.exists() and directory.exists() and any(directory.iterdir()) and part == "runs":
                raise RunDirectoryError(f"{directory} is not empty and is not a corpus: choose another --corpus")
            (directory / part).mkdir(parents=True, exist_ok=True)
        if not path.exists():
            write_json_atomically(path, {"schema": SCHEMA, "scenario": base})
        lock = open_plain_file(path)
    except OSError as error:
        raise RunDirectoryError(f"{directory} cannot be used: {error.strerror}; choose another --corpus") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        header = parse_json(lock.read(64 * MOST_BYTES))
        if not isinstance(header, dict) or header.get("schema") != SCHEMA:
            raise ValueError
    except BlockingIOError:
        raise RunDirectoryError(f"another command works on the corpus in {directory}: wait for its end") from None
    except ValueError:
        raise RunDirectoryError(f"{path} is not a corpus of this version ({SCHEMA}): choose another --corpus") from None
    if header.get("scenario") != json.loads(json.dumps(base)):
        raise RunDirectoryError(f"{directory} is the corpus of another scenario: choose another --corpus")
    return Corpus(directory, base, limits, _lock=lock)


def check_fits(document: Any, base: Document, limits: MutationLimits) -> Document:
    """Return the document if it could result from changes of the base scenario. Otherwise raise ScenarioError."""
    if not isinstance(document, dict):
        raise ScenarioError("it is not a scenario")
    document = {"agents": base["agents"], **document}
    for key in document.keys() | base.keys():
        if key not in CHANGED and not _is_part(document.get(key), base.get(key)):
            raise ScenarioError(f"its `{str(key)[:40]}` differs from the scenario of the corpus")
    scenario = parse(document)
    if not set(scenario.roster) <= set(limits.roster):
        raise ScenarioError("it has agents that the scenario of the corpus does not have")
    if scenario.duration_s > max(LONGEST_S, limits.last_s) or len(scenario.events.script) > MOST_KEPT:
        raise ScenarioError("it is longer than all scenarios of the corpus")
    settles_s = (base.get("settle") or {}).get("limit_s", Scenario.model_fields["settle"].default.limit_s)
    if scenario.settle.limit_s > max(settles_s, LONGEST_S):
        raise ScenarioError("its `settle.limit_s` is greater than in all scenarios of the corpus")
    return {**document, "agents": list(scenario.roster)}


def _is_part(value: Any, whole: Any) -> bool:
    """Return true if `value` equals `whole`, or if `value` is a mapping and `whole` contains all of its entries.
    Entries that are mappings are compared in the same way.
    """
    if isinstance(value, dict) and isinstance(whole, dict):
        return all(_is_part(part, whole.get(key)) for key, part in value.items())
    return bool(value == whole)


def _name_of(candidate: CandidateRun) -> str:
    text = json.dumps(with_liveness_phase(candidate.document), sort_keys=True)  # as it is after reading
    return f"{sha256(text.encode()).hexdigest()[:12]}-seed-{candidate.seed}.yaml"
