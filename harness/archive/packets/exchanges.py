"""Match requests with their answers, and count the losses of each link.

Responses are broadcast and do not name the agent that sent the request. But an agent answers requests immediately and
in order, or not at all. The responses of an agent are therefore assigned from the last to the first. Each response
belongs to the latest request with the same subject that reached the agent before the response, unless a later response
already belongs to this request.

`MessageFilter` selects messages by sender, receiver, type, time or block.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from harness.archive.packets.capture_files import Captures
from harness.archive.packets.capture_reader import CARRY_A_BLOCK, ListenerName
from harness.archive.packets.transmissions import Transmission
from harness.errors import CaptureError
from ucp.messages import TYPE_CODES

Outcome = Literal["answered", "response lost", "request lost", "no answer"]
Subject = tuple[str, bytes | None]
_Asked = tuple[float, int]
"""The mission second of a request, and its position in the order of sending."""


class RequestOutcome(NamedTuple):
    """The result of a request at the vehicle `by`. `response` is the first answer of this vehicle, or None without an
    answer. If the vehicle answered, `outcome` is "answered", or "response lost" if the captures show that the
    requesting agent did not receive the answer. Without an answer, `outcome` is "request lost" if the vehicle did not
    receive the request, otherwise "no answer".
    """

    by: int
    outcome: Outcome
    response: Transmission | None = None


class RequestAnswers:
    """The answers of the vehicles to each captured request."""

    def __init__(self, transmissions: Sequence[Transmission]) -> None:
        self._responses: dict[int, list[Transmission]] = {}
        for request, response in sorted(_match(transmissions), key=lambda pair: pair[1].number):
            self._responses.setdefault(request.number, []).append(response)

    def responses(self, request: Transmission) -> Sequence[Transmission]:
        """Return the answers to a request in the order of sending."""
        return self._responses.get(request.number, ())

    def answers(self, request: Transmission) -> list[RequestOutcome]:
        """Return the outcome of a request at each vehicle that received it or should have received it."""
        first: dict[int, Transmission] = {}
        for response in self.responses(request):
            first.setdefault(response.sender, response)
        answers = [
            RequestOutcome(name, "response lost" if request.sender in response.lost_by else "answered", response)
            for name, response in first.items()
        ]
        silent = {name for name in request.reached if name != request.sender} - first.keys()
        answers += [RequestOutcome(name, "no answer") for name in silent if isinstance(name, int)]
        answers += [
            RequestOutcome(name, "request lost")
            for name in request.lost_by
            if isinstance(name, int) and name not in first
        ]
        return sorted(answers)


def _match(transmissions: Sequence[Transmission]) -> Iterator[tuple[Transmission, Transmission]]:
    """Yield each pair of request and answer. A forged answer is never matched."""
    asked: dict[Subject, list[_Asked]] = {}
    reached: dict[tuple[ListenerName, Subject], list[_Asked]] = {}
    sent: dict[tuple[ListenerName, Subject], list[Transmission]] = {}
    for transmission in transmissions:
        if subject := transmission.summary.request_key:
            asked.setdefault(subject, []).append((transmission.at_s, transmission.number))
            for reception in transmission.received:
                arrivals = [(reception.at_s, transmission.number)] * reception.copies
                arrivals[-1] = reception.last_s, transmission.number
                reached.setdefault((reception.by, subject), []).extend(arrivals)
        elif (subject := transmission.summary.answers) and transmission.origin != "forged":
            sent.setdefault((transmission.sender, subject), []).append(transmission)
    for (name, subject), responses in sent.items():
        # If it is unknown which requests reached the responder, any request of another agent may have reached it.
        others = (what for what in asked.get(subject, ()) if transmissions[what[1]].sender != name)
        waiting = sorted(reached.get((name, subject)) or others)
        for response in reversed(responses):
            while waiting and waiting[-1][0] > response.at_s:
                waiting.pop()
            if waiting:
                yield transmissions[waiting.pop()[1]], response


class LinkLosses(NamedTuple):
    """The losses on a link. The receiver should have received `sent` datagrams, but did not receive `lost` of them."""

    sender: int
    receiver: ListenerName
    sent: int
    lost: int


def count_losses(transmissions: Iterable[Transmission]) -> list[LinkLosses]:
    """Return the losses of all links, sorted by sender and receiver. Forged datagrams are not counted."""
    sent: dict[tuple[int, ListenerName], int] = {}
    lost: dict[tuple[int, ListenerName], int] = {}
    for transmission in transmissions:
        if transmission.origin == "forged":
            continue
        for receiver in (*transmission.reached, *transmission.lost_by):
            sent[transmission.sender, receiver] = sent.get((transmission.sender, receiver), 0) + 1
        for receiver in transmission.lost_by:
            lost[transmission.sender, receiver] = lost.get((transmission.sender, receiver), 0) + 1
    pairs = (
        LinkLosses(sender, receiver, count, lost.get((sender, receiver), 0))
        for (sender, receiver), count in sent.items()
    )
    return sorted(pairs, key=lambda pair: (pair.sender, isinstance(pair.receiver, str), pair.receiver))


def loss_matrix(pairs: list[LinkLosses]) -> Iterator[str]:
    """Yield the lines of a table with a row for each sender and a column for each receiver. A cell has the form
    lost/sent.
    """
    receivers = sorted({pair.receiver for pair in pairs}, key=lambda name: (isinstance(name, str), name))
    cells = {(pair.sender, pair.receiver): f"{pair.lost}/{pair.sent}" for pair in pairs}
    width = max(map(len, [*cells.values(), *map(str, receivers)]), default=0)
    yield "lost/sent, from (down) to (across)"
    yield " ".join([" " * 6, *(f"{receiver:>{width}}" for receiver in receivers)])
    for sender in sorted({pair.sender for pair in pairs}):
        yield " ".join([f"{sender:>6}", *(f"{cells.get((sender, receiver), '-'):>{width}}" for receiver in receivers)])


MESSAGES = [message.NAME for message in TYPE_CODES]


@dataclass(frozen=True)
class MessageFilter:
    """A filter for messages by sender, receiver, type, time and other properties. A property that is None accepts every
    message. The name in `message` may be in upper or lower case.

    Raises CaptureError for an unknown message or an empty time interval.
    """

    sender: int | None = None
    receiver: int | None = None
    message: str | None = None
    between_s: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.message is not None and self.message.lower() not in map(str.lower, MESSAGES):
            raise CaptureError(f"--message {self.message}: no such message; use one of {', '.join(MESSAGES)}")
        if self.between_s is not None and not self.between_s[0] <= self.between_s[1]:
            raise CaptureError("--between {:g} {:g}: the first second is not before the last".format(*self.between_s))

    def filter(self, transmissions: Iterable[Transmission], captures: Captures) -> Iterator[Transmission]:
        """Yield the messages that the filter accepts. If the filter has a receiver, each yielded message contains only
        this receiver. Raises CaptureError if the receiver has no capture.
        """
        vehicles = sorted({capture.vehicle for capture in captures.used if capture.vehicle is not None})
        if self.receiver is not None and self.receiver not in vehicles:
            known = f"captures are of {', '.join(map(str, vehicles))}" if vehicles else "nor of any other vehicle"
            raise CaptureError(f"--to {self.receiver}: no capture of that vehicle; {known}")
        for transmission in transmissions:
            if self._fits(transmission):
                if self.receiver is None:
                    yield transmission
                elif (
                    self.receiver in (narrowed := transmission.for_receiver(self.receiver)).reached or narrowed.lost_by
                ):
                    yield narrowed

    def _fits(self, transmission: Transmission) -> bool:
        return (
            (self.sender is None or transmission.sender == self.sender)
            and (self.message is None or transmission.summary.message.lower() == self.message.lower())
            and (self.between_s is None or self.between_s[0] <= transmission.at_s <= self.between_s[1])
        )


class AnsweredMessage(NamedTuple):
    """A message that is not an answer, together with the answers to it. If a block is selected, only answers about this
    block are included.
    """

    first: Transmission
    answers: Sequence[Transmission]


def exchanges_about(
    block_hash: bytes, transmissions: Iterable[Transmission], exchanges: RequestAnswers
) -> Iterator[AnsweredMessage]:
    """Yield all messages about a block, with their answers, in the order of sending."""
    answer_numbers: set[int] = set()
    for transmission in transmissions:
        answers = [answer for answer in exchanges.responses(transmission) if answer.summary.block_hash == block_hash]
        if (transmission.summary.block_hash == block_hash and transmission.number not in answer_numbers) or answers:
            answer_numbers.update(answer.number for answer in answers)
            yield AnsweredMessage(transmission, answers)


def in_order(exchanges: Iterable[AnsweredMessage]) -> list[Transmission]:
    """Return the messages and all answers to them in the order of sending. Each message occurs once."""
    by_number = {
        transmission.number: transmission
        for exchange in exchanges
        for transmission in (exchange.first, *exchange.answers)
    }
    return [by_number[number] for number in sorted(by_number)]


def block_arrivals(exchanges: Iterable[AnsweredMessage]) -> dict[int, float]:
    """Return the mission second at which each vehicle first received a message that contains the block."""
    first: dict[int, float] = {}
    for transmission in in_order(exchanges):
        if transmission.summary.message in CARRY_A_BLOCK:
            for reception in transmission.received:
                if isinstance(reception.by, int):
                    first[reception.by] = min(reception.at_s, first.get(reception.by, reception.at_s))
    return first
