"""The life of one block on the air: proposals and votes, commits, what reconciles said of it and carried."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from harness.archive.packets.exchanges import Exchanges
from harness.archive.packets.message_summary import CARRY_A_BLOCK
from harness.archive.packets.transmissions import Transmission


class Chapter(NamedTuple):
    """A transmission that is no answer, and the answers to it that are about the block."""

    begins: Transmission
    answers: Sequence[Transmission]


def story(block_hash: bytes, transmissions: Iterable[Transmission], exchanges: Exchanges) -> Iterator[Chapter]:
    """All that is about the block, in the order of sending; answers are with what they answer."""
    answer_numbers: set[int] = set()
    for transmission in transmissions:
        answers = [answer for answer in exchanges.responses(transmission) if answer.summary.block_hash == block_hash]
        if (transmission.summary.block_hash == block_hash and transmission.number not in answer_numbers) or answers:
            answer_numbers.update(answer.number for answer in answers)
            yield Chapter(transmission, answers)


def in_order(chapters: Iterable[Chapter]) -> list[Transmission]:
    """All of a story's transmissions, each once, in the order of sending."""
    by_number = {
        transmission.number: transmission for chapter in chapters for transmission in (chapter.begins, *chapter.answers)
    }
    return [by_number[number] for number in sorted(by_number)]


def carried_to(chapters: Iterable[Chapter]) -> dict[int, float]:
    """Vehicle -> the mission second at which the block itself first reached it."""
    first: dict[int, float] = {}
    for transmission in in_order(chapters):
        if transmission.summary.message in CARRY_A_BLOCK:
            for reception in transmission.received:
                if isinstance(reception.by, int):
                    first[reception.by] = min(reception.at_s, first.get(reception.by, reception.at_s))
    return first
