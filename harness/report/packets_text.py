"""Print messages as text in the order of sending, one line each, for use with `less` and `grep`."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from harness.archive.packets.block_names import BlockNames
from harness.archive.packets.capture_files import Captures
from harness.archive.packets.capture_reader import ListenerName, MessageSummary
from harness.archive.packets.exchanges import AnsweredMessage, Outcome, RequestAnswers, RequestOutcome, block_arrivals
from harness.archive.packets.transmissions import DROPS, ChannelLosses, Transmission, loss_reasons
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
"""Maximum number of receivers whose IDs are listed. If a message has more receivers, only their number is printed."""
_OUTCOMES: tuple[Outcome, ...] = ("answered", "response lost", "no answer", "request lost")
_INDENT = " " * 16

Paint = Callable[[str], str]


class TransmissionFormatter:
    """A formatter for messages and the outcomes of requests. `paint` highlights losses."""

    def __init__(self, names: BlockNames, paint: Paint, losses: ChannelLosses) -> None:
        self._names = names
        self._paint = paint
        self._losses = losses

    def transmission(self, transmission: Transmission) -> str:
        """Return the line for a message: time, sender, content and receivers."""
        what = f"{transmission.summary.message:<26}  {self.content(transmission.summary):<46}"
        parts = [f"{transmission.at_s:>12.3f}  {transmission.sender:>5}  {what}  -> {_receivers(transmission)}"]
        if transmission.lost_by:
            parts.append(self._paint(f"lost by {_list(transmission.lost_by)}{self._reasons(transmission)}"))
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

    def _reasons(self, transmission: Transmission) -> str:
        """Return the reasons why vehicles lost the message on the shared radio channel. Return an empty text if the
        channel caused no loss.
        """
        words = [
            reason.replace("_", " ") + ("" if reason in DROPS else f": {_list(names)}")
            for reason, names in loss_reasons(self._losses, transmission).items()
        ]
        return f" ({'; '.join(words)})" if words else ""

    def content(self, summary: MessageSummary) -> str:
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

    def answers(self, answers: Iterable[RequestOutcome]) -> str:
        """Return the outcomes of a request as text. Vehicles with the same outcome are listed together."""
        together: dict[str, list[ListenerName]] = {}
        for answer in sorted(answers, key=lambda answer: _OUTCOMES.index(answer.outcome)):
            together.setdefault(self._outcome(answer), []).append(answer.by)
        return "answers: " + "; ".join(f"{what}: {_list(names)}" for what, names in together.items())

    def _outcome(self, answer: RequestOutcome) -> str:
        if answer.response is None:
            return self._paint(answer.outcome) if answer.outcome == "request lost" else answer.outcome
        summary = answer.response.summary
        word = str(summary.answer)
        if summary.answer == "block" and summary.block_hash is not None:
            word = f"block {self._names.block(summary.block_hash)}"
        return word if answer.outcome == "answered" else self._paint(f"{word}, but the response was lost")


def header(captures: Captures) -> str:
    """Return a line that names the captured vehicles and the start of mission time."""
    vehicles = sorted({capture.vehicle for capture in captures.used if capture.vehicle is not None})
    points = [capture.path.name for capture in captures.used if capture.vehicle is None]
    clock = captures.clock
    epoch = moment(clock.epoch_ns // 1000)
    second_0 = f"mission second 0 is {epoch}, speedup {clock.speedup:g}" if clock.of_run else f"second 0 is {epoch}"
    listened = f"captures of {_list(vehicles)}" if vehicles else "no vehicle's capture"
    return f"{listened}{', and ' + ', '.join(points) if points else ''}; {second_0}"


def transmission_lines(
    transmissions: Iterable[Transmission],
    exchanges: RequestAnswers,
    text: TransmissionFormatter,
    answers_of: int | None,
) -> Iterator[str]:
    """Yield a line for each message. Below each request, yield the outcomes of the request at all vehicles, or only at
    the vehicle `answers_of`.
    """
    for transmission in transmissions:
        yield text.transmission(transmission)
        if transmission.summary.request_key:
            wanted = [answer for answer in exchanges.answers(transmission) if answers_of in (None, answer.by)]
            if wanted:
                yield f"{_INDENT}   {text.answers(wanted)}"


def exchange_lines(
    exchanges_shown: Sequence[AnsweredMessage], exchanges: RequestAnswers, text: TransmissionFormatter
) -> Iterator[str]:
    """Yield lines about the messages that concern a block, each with its answers and its missing answers.

    The last line lists the vehicles that the block reached.
    """
    for exchange in exchanges_shown:
        yield text.transmission(exchange.first)
        for answer in exchange.answers:
            yield f"    {text.transmission(answer)}"
        if exchange.first.summary.request_key:
            missing = [answer for answer in exchanges.answers(exchange.first) if answer.outcome != "answered"]
            if missing:
                yield f"{_INDENT}   {text.answers(missing)}"
    reached = sorted(block_arrivals(exchanges_shown).items(), key=lambda item: (item[1], item[0]))
    carried = ", ".join(f"{vehicle} at {at_s:.3f} s" for vehicle, at_s in reached)
    yield f"the block reached {carried or 'no vehicle'}"


def totals(captures: Captures, transmissions: Sequence[Transmission]) -> Iterator[str]:
    """Yield lines with the totals of the captures, and with the number of datagrams that are not UCP messages."""
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


def _list(names: Iterable[ListenerName]) -> str:
    return " ".join(map(str, names))


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
