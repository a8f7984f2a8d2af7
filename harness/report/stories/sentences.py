"""Translate the sentences of a story (a text file that describes a mission) into entries of a scenario."""

import re
from collections.abc import Callable
from typing import Any

from harness.errors import ScenarioError
from harness.scenario.faults import TIMELINE_FAULTS
from harness.scenario.load import parse_yaml

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
