"""Read and write story files. A story file contains scenario keys, and then sentences that begin with a mission second.
The reactions of the agents are below each sentence.

    # Figure 3.8: the course of a vote.
    agents: 3
    1 s: 1 logs

        at 1 s
          1    1  Build Data Block: full; completes 1.1
    ...
    30 s: end

The indented text is called the answer. It covers the time until the next later sentence. A test compares the answer
with the run, and can rewrite it.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario.faults import TIMELINE_FAULTS
from harness.scenario.load import parse, parse_yaml
from ucp.plain_file import read_text

EVENT_BYTES = 256
"""Default number of data bytes of an event that a story logs."""

_IDS = r"(\d{1,7}(?: \d{1,7})*)"
_LOGS = re.compile(rf"{_IDS} logs?(?: (\d{{1,7}}) bytes)?")
_CUT = re.compile(rf"{_IDS} do(?:es)? not reach {_IDS}")
_JOINED = re.compile(rf"{_IDS} reach(?:es)? {_IDS} again")
_PARTITION = re.compile(rf"partition {_IDS}((?: \| {_IDS})+)")
_VERB = re.compile(rf"(\w+) {_IDS}")

VERBS = [kind.what for kind in TIMELINE_FAULTS if not kind.further_keys()]
SENTENCES = (
    "`1 2 log` or `1 logs 100 bytes`, `1 does not reach 2 3`, `1 reaches 2 3 again`, `partition 1 2 | 3`, `heal`, "
    f"{', '.join(f'`{verb} 1`' for verb in VERBS)}, an entry of a timeline such as `{{loss: 0.5}}`, `chains`, or `end`"
)


class StoryEntries:
    """The scenario entries that represent the sentences of a story. Entries of `script` represent logged events, and
    entries of `timeline` represent all other sentences. `ends_at_s` is the mission second of the end.
    """

    def __init__(self) -> None:
        self.script: list[dict[str, Any]] = []
        self.timeline: list[dict[str, Any]] = []
        self.ends_at_s: int | None = None

    def add(self, at_s: int, sentence: str) -> None:
        """Add the scenario entries for one sentence of the story. Raises ScenarioError if the sentence has no known
        form.
        """
        if sentence == "end":
            self.ends_at_s = at_s
        elif sentence == "heal":
            self.timeline.append({"at_s": at_s, "heal": True})
        elif sentence.startswith("{"):
            self.timeline.append({"at_s": at_s, **_entry(sentence)})
        elif sentence != "chains" and not any(
            add(at_s, match) for pattern, add in self._patterns() if (match := pattern.fullmatch(sentence))
        ):
            raise ScenarioError(f"{sentence[:80]!r} is not a sentence of a story: use {SENTENCES}")

    def _patterns(self) -> list[tuple[re.Pattern[str], Callable[[int, re.Match[str]], bool]]]:
        return [
            (_LOGS, self._log_events),
            (_CUT, self._cut_links),
            (_JOINED, self._join_links),
            (_PARTITION, self._partition),
            (_VERB, self._fault),
        ]

    def _log_events(self, at_s: int, match: re.Match[str]) -> bool:
        data_bytes = int(match[2] or EVENT_BYTES)
        self.script += [{"at_s": at_s, "agent": agent, "bytes": data_bytes} for agent in _ids(match[1])]
        return True

    def _cut_links(self, at_s: int, match: re.Match[str]) -> bool:
        return self._set_links(at_s, match, 1.0)

    def _join_links(self, at_s: int, match: re.Match[str]) -> bool:
        return self._set_links(at_s, match, 0.0)

    def _set_links(self, at_s: int, match: re.Match[str], loss: float) -> bool:
        link = {"from": _ids(match[1]), "to": _ids(match[2]), "loss": loss}
        self.timeline.append({"at_s": at_s, "network": {"links": [link]}})
        return True

    def _partition(self, at_s: int, match: re.Match[str]) -> bool:
        self.timeline.append(
            {"at_s": at_s, "partition": [_ids(group) for group in match[0].removeprefix("partition").split("|")]}
        )
        return True

    def _fault(self, at_s: int, match: re.Match[str]) -> bool:
        if match[1] not in VERBS:
            return False
        self.timeline.append({"at_s": at_s, match[1]: _ids(match[2])})
        return True


def _ids(text: str) -> list[int]:
    return [int(word) for word in text.split()]


def _entry(sentence: str) -> dict[str, object]:
    try:
        entry = parse_yaml(sentence)
    except ScenarioError:
        raise ScenarioError(f"{sentence[:80]!r} is not an entry of a timeline in YAML") from None
    if not isinstance(entry, dict) or "at_s" in entry:
        raise ScenarioError(f"{sentence[:80]!r} is not an entry of a timeline without `at_s`")
    return entry


MAX_BYTES = 1024 * 1024
MAX_LINES = 20_000
_SENTENCE = re.compile(r"(\d{1,7}) s: +(\S.*)")
_ENTRY = re.compile(r"(`?)(timeline|events\.script)\.(\d+)(?:\.|: )")
INDENT = "    "
DELAY_S = 0.02
SPEEDUP = 10.0
"""Speedup of stories whose agents run as processes. The speedup is limited, because the sentences of a story may be one
second apart, and a change of the network takes some milliseconds.
"""


@dataclass(frozen=True)
class StorySection:
    """The place in a story file at which the reactions of the agents are written, directly after line `line`, counted
    from 0. The reactions are those from mission second `from_s` until `until_s`.
    """

    line: int
    from_s: int
    until_s: int | None
    shows_chains: bool


@dataclass(frozen=True)
class Story:
    """The content of a story file, which describes a mission in sentences. `lines` contains the lines of the file
    without the reactions of the agents.
    """

    path: Path
    text: str
    lines: Sequence[str]
    scenario: Scenario
    sections: Sequence[StorySection]

    @property
    def in_virtual_time(self) -> Scenario:
        """The scenario of the story with a constant message delay. This delay keeps messages in order."""
        if self.scenario.network.delay:
            return self.scenario
        network = self.scenario.network.model_copy(update={"delay": DELAY_S})
        return self.scenario.model_copy(update={"network": network})

    def with_answers(self, answers: Sequence[Sequence[str]]) -> str:
        """Return the text of the story file with new reactions of the agents. `answers` contains a list of lines for
        each section.
        """
        after = {section.line: answer for section, answer in zip(self.sections, answers, strict=True)}
        lines: list[str] = []
        for number, line in enumerate(self.lines):
            if line or (lines and lines[-1]):  # one empty line is enough
                lines.append(line)
            if after.get(number):
                lines += ["", *(f"{INDENT}{text}" for text in after[number]), ""]
        while not lines[-1]:
            lines.pop()
        return "\n".join(lines) + "\n"


def is_story(path: Path) -> bool:
    """Return true if the file is a story of this harness. Files of other tools may also have the suffix `.story`."""
    try:
        lines = read_text(path, MAX_BYTES).splitlines()
        return any(_SENTENCE.fullmatch(line) for line in lines[:MAX_LINES])
    except (OSError, UnicodeDecodeError):
        return False


def read_story(path: Path) -> Story:
    """Read a story file. Raises ScenarioError, which names the file and the line."""
    try:
        text = read_text(path, MAX_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        why = "it is not UTF-8 text" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise ScenarioError(f"{path}: cannot be read: {why}") from None
    try:
        return _parsed(path, text)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None


def _parsed(path: Path, text: str) -> Story:
    file_lines = text.splitlines()
    first = next((number for number, line in enumerate(file_lines) if _SENTENCE.fullmatch(line)), None)
    if first is None:
        raise ScenarioError("it has no sentence, such as `1 s: 1 logs`")
    while first and file_lines[first - 1].startswith("#"):  # the comment above the first sentence
        first -= 1
    lines, parsed = [*file_lines[:first], ""], StoryEntries()
    sentences: list[tuple[int, int, bool]] = []  # line, second, whether chains are shown
    entry_lines: dict[str, list[int]] = {"events.script": [], "timeline": []}  # entry -> its line in the file
    for number, line in enumerate(file_lines[first:], first + 1):
        if line.startswith((" ", "\t")) or not line.strip():
            continue
        if line.startswith("#"):
            lines += [*_gap(lines), line]
            continue
        sentence = _SENTENCE.fullmatch(line)
        if sentence is None:
            raise ScenarioError(
                f"line {number}: {line[:80]!r} is not a sentence: start it with its mission second, such as `12 s: `"
            )
        at_s, words = int(sentence[1]), sentence[2].rstrip()
        if sentences and at_s < sentences[-1][1]:
            raise ScenarioError(
                f"line {number}: {at_s} s is before {sentences[-1][1]} s of an earlier sentence: "
                "order the sentences by time"
            )
        if parsed.ends_at_s is not None:
            raise ScenarioError(f"line {number}: a sentence follows the end")
        try:
            parsed.add(at_s, words)
        except ScenarioError as error:
            raise ScenarioError(f"line {number}: {error}") from None
        for entries, of in zip((parsed.script, parsed.timeline), entry_lines.values(), strict=True):
            of += [number] * (len(entries) - len(of))
        lines.append(line)
        sentences.append((len(lines) - 1, at_s, words in ("chains", "end")))
    if parsed.ends_at_s is None:
        raise ScenarioError("it has no end: add a last sentence such as `60 s: end`")
    try:
        scenario = _scenario(path, file_lines[:first], parsed)
    except ScenarioError as error:
        raise ScenarioError(_in_its_line(str(error), entry_lines)) from None
    return Story(path, text, lines, scenario, _sections(sentences))


def _in_its_line(problem: str, entry_lines: Mapping[str, Sequence[int]]) -> str:
    """Return the error message in a form that names the line of the sentence in the story. The original message names
    the scenario key that the sentence created.
    """
    entry = _ENTRY.match(problem)
    return f"line {entry_lines[entry[2]][int(entry[3])]}: {entry[1]}{problem[entry.end() :]}" if entry else problem


def _gap(lines: Sequence[str]) -> list[str]:
    """Return an empty line if the last line is a sentence. The empty line separates this sentence from the comment that
    follows.
    """
    return [""] if _SENTENCE.fullmatch(lines[-1]) else []


def _sections(sentences: Sequence[tuple[int, int, bool]]) -> list[StorySection]:
    """Return one section for each mission second that the story mentions. The place of a section is after the last
    sentence with this mission second.
    """
    last = {
        at_s: (line, any(chains for _, other_s, chains in sentences if other_s == at_s)) for line, at_s, _ in sentences
    }
    seconds = [*last]
    return [
        StorySection(line, at_s, until_s, chains)
        for (at_s, (line, chains)), until_s in zip(last.items(), [*seconds[1:], None], strict=True)
    ]


def _scenario(path: Path, header: Sequence[str], parsed: StoryEntries) -> Scenario:
    try:
        keys = parse_yaml("\n".join(header)) or {}
    except ScenarioError as error:
        raise ScenarioError(f"the keys before its first sentence are wrong: {error}") from None
    if not isinstance(keys, dict):
        raise ScenarioError("the text before its first sentence must be keys of a scenario with their values")
    if taken := {"timeline", "duration_s", "events"} & keys.keys():
        raise ScenarioError(f"`{min(taken)}` is set by the sentences of the story: leave it out")
    document: dict[str, Any] = {
        "name": path.stem.replace("_", " "),
        "vehicles": {"kind": "none"},
        "speedup": SPEEDUP,
        **keys,
        "events": {"source": "scripted", "script": parsed.script},
        "timeline": parsed.timeline,
        "duration_s": parsed.ends_at_s,
    }
    return parse(document)
