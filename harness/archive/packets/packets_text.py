"""Transmissions for people, in the order of sending, a line for each that stands by itself: for `less` and `grep`."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from harness.archive.packets.air_names import Names
from harness.archive.packets.capture_files import Captures
from harness.archive.packets.capture_reader import Name
from harness.archive.packets.datagram import MessageSummary
from harness.archive.packets.exchanges import Answer, Exchanges, Outcome
from harness.archive.packets.selection import Chapter, carried_to
from harness.archive.packets.transmissions import Transmission
from harness.present.text import moment
from ucp.messages import (
    BlockAddRequest,
    BlockAddResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    NextInSequenceResponse,
)

_NAMED = 10
"""More receivers than these are counted, not named."""
_OUTCOMES: tuple[Outcome, ...] = ("answered", "response lost", "no answer", "request lost")
_INDENT = " " * 16

Paint = Callable[[str], str]


class Wording:
    """How things are said; `paint` sets off what was lost."""

    def __init__(self, names: Names, paint: Paint) -> None:
        self._names = names
        self._paint = paint

    def transmission(self, transmission: Transmission) -> str:
        """When, who, what, and who received it."""
        what = f"{transmission.summary.message:<26}  {self.in_words(transmission.summary):<46}"
        parts = [f"{transmission.at_s:>12.3f}  {transmission.sender:>5}  {what}  -> {_receivers(transmission)}"]
        if transmission.lost_by:
            parts.append(self._paint(f"lost by {_list(transmission.lost_by)}"))
        if transmission.absent:
            parts.append(f"not listening: {_list(transmission.absent)}")
        parts += [
            f"again at {reception.by}: {reception.copies} copies until {reception.last_s:.3f} s"
            for reception in transmission.received
            if reception.copies > 1
        ]
        if transmission.origin == "forged":
            by = "" if transmission.seen_leaving is None else f", but by {transmission.seen_leaving}"
            parts.append(self._paint(f"forged: not sent by {transmission.sender}{by}"))
        elif transmission.origin == "inferred":
            parts.append(f"seen by others: {transmission.sender} was not captured")
        return "  ".join(parts)

    def in_words(self, summary: MessageSummary) -> str:
        if summary.is_sealed:
            return "sealed"
        block = "" if summary.block_hash is None else f"block {self._names.block(summary.block_hash)}"
        chain = "" if summary.chain_hash is None else f"chain {self._names.chain(summary.chain_hash)}"
        match summary.message:
            case BlockAddRequest.NAME:
                return f"{block} on {chain}"
            case BlockAddResponse.NAME:
                return f"{summary.answer} {block}" + (f" on {chain}" if chain else "")
            case CommitBlock.NAME:
                return f"{block} makes {chain}"
            case ChainContainQuery.NAME:
                return f"{chain}?"
            case ChainContainResponse.NAME:
                return f"{summary.answer} {chain}"
            case ChainHashSuccessorQuery.NAME:
                return f"after {chain}?"
            case NextInSequenceResponse.NAME:
                return f"{block or summary.answer} after {chain}"
            case _:
                return block

    def answers(self, answers: Iterable[Answer]) -> str:
        """What came of a request; vehicles of which the same is to say are together."""
        together: dict[str, list[Name]] = {}
        for answer in sorted(answers, key=lambda answer: _OUTCOMES.index(answer.outcome)):
            together.setdefault(self._outcome(answer), []).append(answer.by)
        return "answers: " + "; ".join(f"{what}: {_list(who)}" for what, who in together.items())

    def _outcome(self, answer: Answer) -> str:
        if answer.response is None:
            return self._paint(answer.outcome) if answer.outcome == "request lost" else answer.outcome
        summary = answer.response.summary
        word = str(summary.answer)
        if summary.answer == "block" and summary.block_hash is not None:
            word = f"block {self._names.block(summary.block_hash)}"
        return word if answer.outcome == "answered" else self._paint(f"{word}, but the response was lost")


def head(captures: Captures) -> str:
    """What the times count from, and who listened."""
    vehicles = sorted({capture.vehicle for capture in captures.used if capture.vehicle is not None})
    points = [capture.path.name for capture in captures.used if capture.vehicle is None]
    clock = captures.clock
    epoch = moment(clock.epoch_ns // 1000)
    second_0 = f"mission second 0 is {epoch}, speedup {clock.speedup:g}" if clock.of_run else f"second 0 is {epoch}"
    listened = f"captures of {_list(vehicles)}" if vehicles else "no vehicle's capture"
    return f"{listened}{', and ' + ', '.join(points) if points else ''}; {second_0}"


def lines(
    transmissions: Iterable[Transmission], exchanges: Exchanges, wording: Wording, answers_of: int | None
) -> Iterator[str]:
    """Each transmission; below a request, what came of it at each vehicle, or at `answers_of` alone."""
    for transmission in transmissions:
        yield wording.transmission(transmission)
        if transmission.summary.asks:
            wanted = [answer for answer in exchanges.answers(transmission) if answers_of in (None, answer.by)]
            if wanted:
                yield f"{_INDENT}   {wording.answers(wanted)}"


def life(chapters: Sequence[Chapter], exchanges: Exchanges, wording: Wording) -> Iterator[str]:
    """A block's story: answers below what they answer, then who never gave one, and at last whom the block reached."""
    for chapter in chapters:
        yield wording.transmission(chapter.begins)
        for answer in chapter.answers:
            yield f"    {wording.transmission(answer)}"
        if chapter.begins.summary.asks:
            missing = [answer for answer in exchanges.answers(chapter.begins) if answer.outcome != "answered"]
            if missing:
                yield f"{_INDENT}   {wording.answers(missing)}"
    reached = sorted(carried_to(chapters).items(), key=lambda item: (item[1], item[0]))
    carried = ", ".join(f"{vehicle} at {at_s:.3f} s" for vehicle, at_s in reached)
    yield f"the block reached {carried or 'no vehicle'}"


def tail(captures: Captures, transmissions: Sequence[Transmission]) -> Iterator[str]:
    """Totals, and what else was in the captures."""
    lost = sum(len(transmission.lost_by) for transmission in transmissions)
    received = sum(len(transmission.received) for transmission in transmissions)
    counted = [
        _count(len(transmissions), "datagram"),
        f"received {_count(received, 'time')}, lost {_count(lost, 'time')}",
        *(
            f"{count} {what}"
            for what in ("inferred", "forged")
            if (count := sum(transmission.origin == what for transmission in transmissions))
        ),
    ]
    yield ", ".join(counted)
    for title, counters in (
        ("malformed", {capture.name: capture.malformed for capture in captures.used}),
        ("not UCP", {capture.name: capture.not_ucp for capture in captures.used}),
    ):
        total: Counter[str] = sum(counters.values(), Counter())
        for reason, count in total.most_common():
            where = _list([name for name, counter in counters.items() if counter[reason]])
            yield f"{title}: {_count(count, 'frame')}, {reason}, at {where}"


def _receivers(transmission: Transmission) -> str:
    if not transmission.received:
        return "no vehicle"
    if len(transmission.received) <= _NAMED:
        return _list(transmission.reached)
    return f"{len(transmission.received)} of {len(transmission.received) + len(transmission.lost_by)}"


def _list(names: Iterable[Name]) -> str:
    return " ".join(map(str, names))


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
