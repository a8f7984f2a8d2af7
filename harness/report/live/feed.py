"""Read a run directory as one stream of changes, during the run or afterwards.

A change is a list: its kind, its mission second, and further values. Blocks are identified by `KEY_LENGTH` digits of
their hashes.

| kind | values after the mission second |
|---|---|
| `p` | vehicle -> metres north, east and up |
| `n` | a change of network or agents: what, detail, agents, their state, [low, high, loss there, loss back] of each
        changed pair, the parts of the swarm if they changed, and whether it was caused by hand |
| `b` | a block was completed: key, agent, ordinal |
| `c` | an agent's blocks moved: agent, [operation, key] of each, top chain hash, cause of the commit |
| `z` | an agent began a new incarnation without blocks: agent |
| `s` | an agent's activity: agent, word, detail |
| `m` | a broadcast: agent, message, key or null, receivers as a hexadecimal mask (bit n is the nth of the roster),
        sequence number |
| `h` | further receivers of a broadcast of that second: agent, all receivers as a mask, sequence number |
| `d` | an agent dropped a datagram: agent, reason |
| `x` | a visible violation of a characteristic: agent, number, key |
| `t` | the current mission second |
| `gap` | messages before that second were left out |
| `late` | seconds of wall time in place of the second, by which the changes are late; true if messages are left out |
| `all` | traces contain every received message: a missing receipt means a lost message |
| `run`, `end`, `note` | a document in place of the second: the run; its outcome; a sentence about unreadable parts |
"""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from math import isinf
from operator import itemgetter
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.connectivity import QUALITY_LIMITS
from harness.archive.exports import RUN_FILE, agents_directory
from harness.archive.record_file import read_record
from harness.archive.run_record import RunRecord
from harness.errors import RunDirectoryError
from harness.play.backends import in_virtual_time
from harness.present.colours import inks
from harness.report.facts import link_qualities
from harness.report.live._agent_course import AgentActions, Change, MessageReceipt, SentMessage
from harness.report.live._surroundings import NetworkAndVehicles
from harness.scenario.faults import TIMELINE_FAULTS, VehicleFault
from harness.scenario.verdict_names import kind_of

MAX_VEHICLES = 200
"""Maximum number of vehicles in a swarm whose links the page can draw."""
LINES_AT_ONCE = 500
"""Maximum number of lines that are read from one file before the reader continues with the next file. Omitted lines do
not count.
"""
LINES_AT_ONCE_LATE = 50
POLLS_UNTIL_REPORTED = 2
"""Number of polls for which a message waits before the page shows it. After this time, most receivers have recorded the
message. If a receiver on a busy machine records the message later, the page receives a change of the kind `h`.
"""
MAX_BEHIND_S = 2.0
"""Number of seconds of wall time. If the feed is behind an active run by more than this number, it omits messages until
it has caught up.
"""
MAX_KEPT = 100_000
"""Maximum number of messages for which further receivers can still be added on the page. The same limit applies to
messages that only receivers have recorded.
"""


@dataclass
class _Broadcast:
    """A broadcast message. `message` is None until the reader finds the message in the trace of the sender."""

    mask: int
    polls: int
    t: float = 0.0
    message: str | None = None
    block: str | None = None

    def add_receiver(self, bit: int) -> bool:
        """Add a receiver of the message. `bit` is the bit that represents the receiver in masks. Return true if the
        receiver is new.
        """
        before = self.mask
        self.mask |= bit
        return self.mask != before


class RunClock:
    """The mission seconds that an active run reported, with the wall time of each report."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._reports: deque[tuple[float, float]] = deque()

    def report(self, now_s: float) -> None:
        self.now_s = now_s
        self._reports.append((now_s, time.monotonic()))

    def wall_s_since(self, mission_s: float) -> float:
        """Return the wall time that has passed since this mission second. Reports of earlier mission seconds are
        deleted.
        """
        while self._reports and self._reports[0][0] <= mission_s:
            self._reports.popleft()
        return time.monotonic() - self._reports[0][1] if self._reports else 0.0


class ChangeFeed:
    """The stream of changes in a run directory.

    Raises RunDirectoryError if the directory contains no run, if the run contains no data for the page, or if it has
    more than `MAX_VEHICLES` vehicles.
    """

    def __init__(self, directory: Path) -> None:
        archive = RunArchive(directory)
        self._directory = directory
        self._roster = archive.roster
        if not self._roster:
            raise RunDirectoryError(f"{directory}: nothing to watch: it has neither {RUN_FILE} nor traces")
        if len(self._roster) > MAX_VEHICLES:
            raise RunDirectoryError(
                f"{directory}: {len(self._roster)} vehicles are in this run, but the page shows at most "
                f"{MAX_VEHICLES}: use `ucp-harness report` or `export`"
            )
        agents = agents_directory(directory)
        self._bit = {agent_id: 1 << number for number, agent_id in enumerate(self._roster)}
        self._courses = [AgentActions(agents, agent_id) for agent_id in self._roster]
        self._surroundings = NetworkAndVehicles(directory, self._roster)
        self._broadcasts: dict[tuple[int, int], _Broadcast] = {}
        self._reported: dict[tuple[int, int], _Broadcast] = {}
        """The last messages that were sent to the page, by sender and sequence number."""
        self._polls = 0
        self._leaves_out_messages = False
        self._messages_from_s = -1.0
        """Mission second up to which messages are omitted, because not all of their receivers are known."""
        self._reported_late: Change = ["late", 0, False]
        self._reported_s = 0.0
        self._reported_problems: set[str] = set()
        self._record = archive.record
        self._all_receipts_recorded = self._record.backend is not None and not in_virtual_time(self._record.backend)
        self._record_stamp = self._stamp()

    def run_change(self, *, live: bool) -> Change:
        """Return the first change, which describes the run. `live` is true if the run is still active."""
        record, scenario = self._record, self._record.scenario
        return [
            "run",
            {
                "name": scenario.name if scenario else self._directory.name,
                "directory": self._directory.name,
                "roster": self._roster,
                "types": [scenario.vehicles.type_of(agent) if scenario else "copter" for agent in self._roster],
                "inks": [[ink.fill, ink.stroke, ink.text, ink.dashed] for ink in inks(self._roster).values()],
                "quality_limits": QUALITY_LIMITS,
                "link_qualities": link_qualities(),
                "duration_s": scenario.duration_s if scenario else None,
                "speedup": scenario.speedup if scenario else None,
                "backend": record.backend,
                "seed": record.seed,
                "live": live,
                "all_heard": self._all_receipts_recorded,
                "flown": self._is_flown(),
                "troubles": [
                    [kind.what, kind.default_values] for kind in TIMELINE_FAULTS if issubclass(kind, VehicleFault)
                ],
            },
        ]

    def _is_flown(self) -> bool:
        """Return true if the vehicles of the run are real programs. Only real programs can have vehicle faults."""
        record, scenario = self._record, self._record.scenario
        has_vehicles = scenario is not None and scenario.vehicles.kind != "none"
        return has_vehicles and record.backend is not None and not in_virtual_time(record.backend)

    def poll(self, until_s: float = float("inf")) -> tuple[list[Change], bool]:
        """Return a pair: the new changes up to mission second `until_s`, and whether there are further changes up to
        this second.
        """
        more = self._surroundings.read(until_s, LINES_AT_ONCE)
        at_once = LINES_AT_ONCE_LATE if self._leaves_out_messages else LINES_AT_ONCE
        for course in self._courses:
            more |= course.read(until_s, at_once)
        # In a film, an agent with unread lines may still have received older messages. A live page cannot wait for it.
        self._polls += not more or isinf(until_s)
        changes = [*self._take_changes(), *self._messages(report_all=False)]
        changes.sort(key=lambda change: float(change[1]))
        at_s = max(self._surroundings.at_s, *(course.at_s for course in self._courses))
        if at_s > self._reported_s:
            self._reported_s = at_s
            changes.append(["t", round(at_s, 3)])
        if not self._all_receipts_recorded and any(course.has_messages_without_effect for course in self._courses):
            self._all_receipts_recorded = True
            changes.append(["all", self._reported_s])
        return [*changes, *self._notes()], more

    def poll_live(self, clock: RunClock) -> tuple[list[Change], bool]:
        """Return the new changes of an active run, and whether more changes remain unread.

        If the feed is far behind the run, it omits messages, because most lines of the traces are about messages. The
        page shows by how many seconds the feed is late.
        """
        changes, more = self.poll()
        unread = (course.at_s for course in self._courses if course.has_unread)
        late_s = clock.wall_s_since(min(unread, default=clock.now_s))
        if not self._leaves_out_messages and late_s > MAX_BEHIND_S:
            self._leave_out_messages(True)
        elif self._leaves_out_messages and not more:
            self._leave_out_messages(False)
            self._messages_from_s = max(course.at_s for course in self._courses)
            changes.append(["gap", self._messages_from_s])
        late: Change = ["late", round(late_s), self._leaves_out_messages]
        if late != self._reported_late:
            self._reported_late = late
            changes.append(late)
        if not more and clock.now_s > self._reported_s:
            self._reported_s = clock.now_s
            changes.append(["t", round(clock.now_s, 3)])
        return changes, more

    def _leave_out_messages(self, leave_out: bool) -> None:
        self._leaves_out_messages = leave_out
        for course in self._courses:
            course.leaves_out_messages = leave_out
        self._broadcasts.clear()
        self._reported.clear()

    def final_changes(self) -> list[Change]:
        """Return all remaining changes, and the result of the run."""
        changes = [*self._take_changes(), *self._messages(report_all=True)]
        return [*changes, *self._notes(), ["end", self._ending()]]

    @property
    def next_s(self) -> float | None:
        """The mission second of the next entry, which was already read but is not processed yet. The value is None if
        there is no such entry.
        """
        ahead = (self._surroundings.next_s, *(course.next_s for course in self._courses))
        return min((at_s for at_s in ahead if at_s is not None), default=None)

    @property
    def over(self) -> bool:
        """True if run.json contains the verdicts of the run, or states that the run failed."""
        stamp = self._stamp()
        if stamp != self._record_stamp:
            self._record_stamp = stamp
            self._record = read_record(self._directory / RUN_FILE).record
        return self._record.outcome == "failed" or bool(self._record.characteristics)

    def close(self) -> None:
        self._surroundings.close()
        for course in self._courses:
            course.close()

    def _take_changes(self) -> Iterator[Change]:
        for changes in (self._surroundings.changes, *(course.changes for course in self._courses)):
            for change in changes:
                if change[0] == "z":  # the new incarnation may use the same sequence numbers
                    self._reported = {key: sent for key, sent in self._reported.items() if key[0] != change[2]}
                yield change
            changes.clear()

    def _messages(self, *, report_all: bool) -> Iterator[Change]:
        """Yield the messages whose receivers have probably recorded them by now. If `report_all` is true, yield all
        messages.
        """
        happened: list[tuple[float, int, int, SentMessage | MessageReceipt]] = []
        for course in self._courses:
            happened += [(sent.t, 0, course.agent_id, sent) for sent in course.sent]
            happened += [(receipts.t, 1, course.agent_id, receipts) for receipts in course.receipts]
            course.sent.clear()
            course.receipts.clear()
        if self._leaves_out_messages:
            return
        happened.sort(key=itemgetter(0, 1))
        late: dict[tuple[int, int], _Broadcast] = {}
        for _, _, agent_id, what in happened:
            if isinstance(what, MessageReceipt):
                key = what.sender, what.seq
                if key in self._reported and key not in self._broadcasts:
                    if (reported := self._reported[key]).add_receiver(self._bit[agent_id]):
                        late[key] = reported
                    continue
                if key not in self._broadcasts:
                    self._broadcasts[key] = _Broadcast(0, self._polls)
                self._broadcasts[key].add_receiver(self._bit[agent_id])
                continue
            if what.t <= self._messages_from_s:
                continue
            key = agent_id, what.seq
            before = self._broadcasts.get(key)
            if before is not None and before.message is not None:
                yield self._message_change(key, before)  # another incarnation reuses the number
                before = None
            mask = before.mask if before else 0
            self._broadcasts[key] = _Broadcast(mask, self._polls, what.t, what.message, what.block)
        old = self._polls if report_all else self._polls - POLLS_UNTIL_REPORTED
        due = [key for key, each in self._broadcasts.items() if each.message is not None and each.polls <= old]
        for key in due:
            self._reported[key] = self._broadcasts.pop(key)
            yield self._message_change(key, self._reported[key])
        for (sender, sequence), broadcast in late.items():
            yield ["h", broadcast.t, sender, f"{broadcast.mask:x}", sequence]
        for kept in (self._reported, self._broadcasts):
            for key in [*islice(kept, max(0, len(kept) - MAX_KEPT))]:
                del kept[key]

    def _message_change(self, key: tuple[int, int], broadcast: _Broadcast) -> Change:
        sender, sequence = key
        return ["m", broadcast.t, sender, broadcast.message, broadcast.block, f"{broadcast.mask:x}", sequence]

    def _notes(self) -> Iterator[Change]:
        """Yield a sentence about each new problem with the files."""
        damaged = (course.problem for course in self._courses)
        for sentence in chain(self._surroundings.problems, damaged):
            if sentence is not None and sentence not in self._reported_problems:
                self._reported_problems.add(sentence)
                yield ["note", sentence]

    def _ending(self) -> dict[str, object]:
        record = self._record if self.over else RunRecord()
        return {
            "outcome": record.outcome,
            "detail": record.outcome_detail,
            "judgements": [
                [
                    key,
                    judgement.name,
                    record.expect.in_words(key, judgement.verdict),
                    judgement.reason,
                    kind_of(judgement.verdict),
                ]
                for key, judgement in record.judgements.items()
            ],
            "report": (self._directory / "report.html").is_file(),
        }

    def _stamp(self) -> tuple[int, int] | None:
        try:
            status = (self._directory / RUN_FILE).stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_ino
