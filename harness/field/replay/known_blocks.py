"""Blocks by hash, wherever any record of the flight has them."""

from collections.abc import Iterator

from harness.archive.traces import Trace
from harness.checker.steps.recorded_inputs import Blocks, NotOnRecordError, decoded
from harness.field.replay.agent_record import Record
from ucp.block import Block
from ucp.messages import BlockResponse, CommitBlock, MalformedDatagramError


class RecordedBlocks(Blocks):
    """What was played by now makes no difference to what is known."""

    def __init__(self, record: Record) -> None:
        super().__init__(())
        self._record = record
        self._unread = self._sources()

    def get(self, block_hash: str) -> Block:
        while True:
            try:
                return super().get(block_hash)
            except NotOnRecordError:
                source = next(self._unread, None)
                if source is None:
                    raise
            for block in source:
                self.add(block)

    def _sources(self) -> Iterator[Iterator[Block]]:
        """What is to be read, the quickest first."""
        yield _blocks_of(self._record.trace)
        yield self._of_exports()
        yield from map(_blocks_of, self._record.beside.traces.values())

    def _of_exports(self) -> Iterator[Block]:
        for export in self._record.beside.exports.values():
            for exported in export.blocks():
                yield Block(exported.agent_id, exported.timestamp_us, exported.event_bytes)


def _blocks_of(trace: Trace) -> Iterator[Block]:
    """Those that the agent received or sent whole."""
    for run in trace.runs:
        datagrams = [run.input] if "message" in run.trigger else []
        for datagram in (*datagrams, *(sent.datagram for sent in run.sent)):
            try:
                message = decoded(datagram).message
            except MalformedDatagramError:
                continue
            if isinstance(message, CommitBlock | BlockResponse):
                yield message.block
