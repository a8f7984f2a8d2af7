"""Requests with their responses, and the losses between each two vehicles.

Responses are broadcast and do not name the asker. But an agent answers what reaches it at once or never, and in order:
so, from the last response back to the first, each answers the last request on its subject that reached the responder
before it, and that no later response answers.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

from harness.archive.packets.capture_reader import ListenerName
from harness.archive.packets.transmissions import Transmission

Outcome = Literal["answered", "response lost", "request lost", "no answer"]
Subject = tuple[str, bytes | None]
_Asked = tuple[float, int]
"""When, and the number of the request."""


class RequestOutcome(NamedTuple):
    """What came of a request at one vehicle: `response` is its first answer, if it gave one.

    It is "answered" unless the response is known to be lost to the asker.
    """

    by: int
    outcome: Outcome
    response: Transmission | None = None


class Exchanges:
    def __init__(self, transmissions: Sequence[Transmission]) -> None:
        self._responses: dict[int, list[Transmission]] = {}
        for request, response in sorted(_match(transmissions), key=lambda pair: pair[1].number):
            self._responses.setdefault(request.number, []).append(response)

    def responses(self, request: Transmission) -> Sequence[Transmission]:
        """In the order of sending."""
        return self._responses.get(request.number, ())

    def answers(self, request: Transmission) -> list[RequestOutcome]:
        """What came of a request at each vehicle that it reached or should have reached."""
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
    """(request, response). A forged response is nobody's answer."""
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
        # Where it is not known what reached the responder, all that others asked may have.
        others = (what for what in asked.get(subject, ()) if transmissions[what[1]].sender != name)
        waiting = sorted(reached.get((name, subject)) or others)
        for response in reversed(responses):
            while waiting and waiting[-1][0] > response.at_s:
                waiting.pop()
            if waiting:
                yield transmissions[waiting.pop()[1]], response


class LinkLosses(NamedTuple):
    """Of `sent` datagrams that the receiver should have heard, `lost` never reached it."""

    sender: int
    receiver: ListenerName
    sent: int
    lost: int


def count_losses(transmissions: Iterable[Transmission]) -> list[LinkLosses]:
    """All pairs, by sender and receiver. What somebody forged is no agent's loss."""
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
    """A row for each sender, a column for each receiver: lost/sent."""
    receivers = sorted({pair.receiver for pair in pairs}, key=lambda name: (isinstance(name, str), name))
    cells = {(pair.sender, pair.receiver): f"{pair.lost}/{pair.sent}" for pair in pairs}
    width = max(map(len, [*cells.values(), *map(str, receivers)]), default=0)
    yield "lost/sent, from (down) to (across)"
    yield " ".join([" " * 6, *(f"{receiver:>{width}}" for receiver in receivers)])
    for sender in sorted({pair.sender for pair in pairs}):
        yield " ".join([f"{sender:>6}", *(f"{cells.get((sender, receiver), '-'):>{width}}" for receiver in receivers)])
