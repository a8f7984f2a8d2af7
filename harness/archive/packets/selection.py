"""Select messages by sender, receiver, type, time or block."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from harness.archive.packets.capture_files import Captures
from harness.archive.packets.datagram import CARRY_A_BLOCK
from harness.archive.packets.exchanges import RequestAnswers
from harness.archive.packets.transmissions import Transmission
from harness.errors import CaptureError
from ucp.messages import TYPE_CODES

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
