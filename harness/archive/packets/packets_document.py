"""Define the JSON output of `ucp-harness packets` (`ucp-packets/1`). Later versions may add keys, but never remove or
rename one.
"""

import json
from collections.abc import Iterable, Iterator
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.packets.block_names import BlockNames
from harness.archive.packets.capture_files import CaptureClock, Captures
from harness.archive.packets.capture_reader import Capture, ListenerName
from harness.archive.packets.exchanges import LinkLosses, Outcome, RequestAnswers
from harness.archive.packets.transmissions import ChannelLosses, Origin, Transmission, loss_reasons

SCHEMA = "ucp-packets/1"

_ListenerName = Annotated[
    ListenerName, Field(description="A vehicle's ID, or the name of a point that is no vehicle's.")
]


class CaptureRecord(BaseModel):
    """One capture file. It covers the mission seconds `began_s` to `ended_s`, which are null if the file is empty.
    `dropped` is the number of frames that are missing in the file.
    """

    file: str
    vehicle: int | None
    began_s: float | None
    ended_s: float | None
    frames: int
    dropped: int | None
    not_ucp: dict[str, int]
    malformed: dict[str, int]
    problems: list[str]


class PairRecord(BaseModel):
    """The datagrams from one sender to one receiver. The receiver should have received `sent` datagrams, and did not
    receive `lost` of them.
    """

    sender: int
    receiver: _ListenerName
    sent: int
    lost: int


class ReceptionRecord(BaseModel):
    """The reception of a datagram: the number of copies, and the times of the first copy (`at_s`) and the last copy."""

    by: _ListenerName
    at_s: float
    copies: int
    last_s: float


class AnswerRecord(BaseModel):
    """The outcome of a request at vehicle `by`: the answer of the vehicle, and the number of the datagram with this
    answer. The number is null without an answer.
    """

    by: int
    outcome: Outcome
    answer: str | None
    response: int | None


class DatagramRecord(BaseModel):
    """One datagram, sent once. `number` is its position in the order of sending. `answers` is null if the message is
    not a request.

    `origin` is `captured` (the capture of the sender contains the datagram), `inferred` (the sender captured no packets
    at that time, so `at_s` is the time of the first reception) or `forged` (the agent that the datagram names as its
    sender did not send it). `lost_by` lists vehicles that captured packets at that time but did not receive the
    datagram. `not_listening` lists vehicles that captured no packets at that time. `loss_reasons` maps each reason for
    which the shared channel lost the message to vehicles in `lost_by`. Without such a loss, the key `loss_reasons` is
    missing.
    """

    number: int
    at_s: float
    sender: int
    sequence: int
    message: str
    block: str | None
    block_hash: str | None
    chain_hash: str | None
    answer: str | None
    origin: Origin
    seen_leaving: _ListenerName | None
    received: list[ReceptionRecord]
    lost_by: list[_ListenerName]
    loss_reasons: dict[str, list[_ListenerName]] = {}
    not_listening: list[_ListenerName]
    answers: list[AnswerRecord] | None


class PacketsRecord(BaseModel):
    """The datagrams in several captures. All times are mission seconds, and `epoch_us` is the time of mission second 0.
    If the captures do not come from a run, `epoch_us` is the time of the first packet.
    """

    model_config = ConfigDict(populate_by_name=True)

    schema_: Annotated[Literal["ucp-packets/1"], Field(alias="schema")] = "ucp-packets/1"
    epoch_us: int
    speedup: float
    of_run: bool
    captures: list[CaptureRecord]
    losses: list[PairRecord]
    errors: list[str]
    datagrams: list[DatagramRecord]


def document(
    captures: Captures,
    pairs: Iterable[LinkLosses],
    shown: Iterable[Transmission],
    exchanges: RequestAnswers,
    names: BlockNames,
    losses: ChannelLosses,
) -> Iterator[str]:
    """Yield the lines of a JSON document with all data. Each datagram has its own line."""
    clock = captures.clock
    packets = PacketsRecord(
        epoch_us=clock.epoch_ns // 1000,
        speedup=clock.speedup,
        of_run=clock.of_run,
        captures=[_capture(capture, clock) for capture in captures.used],
        losses=[PairRecord(**pair._asdict()) for pair in pairs],
        errors=captures.errors,
        datagrams=[],
    )
    whole = packets.model_dump(mode="json", by_alias=True)
    del whole["datagrams"]
    yield json.dumps(whole)[:-1] + ', "datagrams": ['
    separator = ""
    for transmission in shown:
        record = _datagram(transmission, exchanges, names)
        if reasons := loss_reasons(losses, transmission):
            record.loss_reasons = reasons
        yield separator + record.model_dump_json(exclude_unset=True)
        separator = ","
    yield "]}"


def _capture(capture: Capture, clock: CaptureClock) -> CaptureRecord:
    return CaptureRecord(
        file=str(capture.path),
        vehicle=capture.vehicle,
        began_s=None if capture.began_ns is None else clock.seconds(capture.began_ns),
        ended_s=None if capture.ended_ns is None else clock.seconds(capture.ended_ns),
        frames=capture.frames,
        dropped=capture.dropped,
        not_ucp=dict(capture.not_ucp),
        malformed=dict(capture.malformed),
        problems=capture.problems,
    )


def _datagram(transmission: Transmission, exchanges: RequestAnswers, names: BlockNames) -> DatagramRecord:
    summary = transmission.summary
    answers = [
        AnswerRecord(
            by=answer.by,
            outcome=answer.outcome,
            answer=answer.response.summary.answer if answer.response else None,
            response=answer.response.number if answer.response else None,
        )
        for answer in exchanges.answers(transmission)
    ]
    return DatagramRecord(
        number=transmission.number,
        at_s=transmission.at_s,
        sender=transmission.sender,
        sequence=transmission.sequence,
        message=summary.message,
        block=None if summary.block_hash is None else names.known(summary.block_hash),
        block_hash=None if summary.block_hash is None else summary.block_hash.hex(),
        chain_hash=None if summary.chain_hash is None else summary.chain_hash.hex(),
        answer=summary.answer,
        origin=transmission.origin,
        seen_leaving=transmission.seen_leaving,
        received=[ReceptionRecord(**reception._asdict()) for reception in transmission.received],
        lost_by=list(transmission.lost_by),
        not_listening=list(transmission.absent),
        answers=answers if summary.request_key else None,
    )
