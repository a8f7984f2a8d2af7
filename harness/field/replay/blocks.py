"""Blocks by hash, wherever any record of the flight has them."""

from collections.abc import Iterator

from harness.checker.steps.inputs import Blocks, NotOnRecordError, decoded
from harness.field.replay.record import Record
from ucp.block import Block
from ucp.messages import MalformedDatagramError


class RecordedBlocks(Blocks):
    """What was played by now makes no difference to what is known."""

    def __init__(self, record: Record) -> None:
        super().__init__(())
        self._record = record
        self._looked = False

    def get(self, block_hash: str) -> Block:
        try:
            return super().get(block_hash)
        except NotOnRecordError:
            if self._looked:
                raise
        self._looked = True
        for block in self._everywhere():
            self.add(block)
        return super().get(block_hash)

    def _everywhere(self) -> Iterator[Block]:
        for export in self._record.beside.exports.values():
            for exported in export.blocks():
                yield Block(exported.agent_id, exported.timestamp_us, exported.event_bytes)
        for trace in (self._record.trace, *self._record.beside.traces.values()):
            for run in trace.runs:
                datagrams = [run.input] if "message" in run.trigger else []
                for datagram in (*datagrams, *(sent.datagram for sent in run.sent)):
                    try:
                        message = decoded(datagram).message
                    except MalformedDatagramError:
                        continue
                    if (block := getattr(message, "block", None)) is not None:
                        yield block
