"""Return tables of a run for notebooks: its handler runs and its blocks, as polars DataFrames.

Each batch of records is converted to columns before the next batch is read. Memory therefore holds only the finished
columns and one batch. `DataFrame.write_parquet` stores a large table in a file.

polars is an optional dependency (extra `data`). Polars was chosen over pandas for three reasons:

- Polars writes Parquet itself, whereas pandas needs pyarrow and NumPy.
- A column has one declared type even with missing values.
- The import of polars takes a third of the time.
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any, TypeVar

from harness.archive.archive import HeldBlock, RecordedRun, RunArchive
from harness.errors import extra
from ucp.trigger import MessageTrigger, Trigger

with extra("data", "a table"):
    import polars as pl

__all__ = ["pl"]


BATCH = 20_000
"""Maximum number of records that are in memory before they are converted to columns."""

Record = TypeVar("Record")
Columns = Mapping[str, tuple[Any, Callable[[Record], Any]]]
"""The definition of each column, by name. The definition consists of the type of the column, and a function that
computes the value of the column from a record.
"""

_NAME = pl.Categorical
"""Column type for text with few distinct values."""

_HANDLER_RUN: Columns[RecordedRun] = {
    "agent": (pl.Int64, lambda each: each.agent_id),
    "life": (pl.Int64, lambda each: each.life),
    "line": (pl.Int64, lambda each: each.line),
    "t_s": (pl.Float64, lambda each: each.run.t),
    "handler": (_NAME, lambda each: each.run.handler),
    "algorithm": (pl.Int64, lambda each: each.run.algorithm),
    "branch": (_NAME, lambda each: each.run.branch),
    "trigger": (_NAME, lambda each: each.run.trigger.kind),
    "subject": (_NAME, lambda each: str(each.run.trigger.subject)),
    "sender": (pl.Int64, lambda each: _sender(each.run.trigger)),
    "operations": (pl.List(_NAME), lambda each: [operation for operation, _ in each.run.changes]),
    "blocks": (pl.List(pl.String), lambda each: [block for _, block in each.run.changes]),
    "sent": (pl.List(_NAME), lambda each: [sent.message for sent in each.run.sent]),
    "chain": (pl.Int64, lambda each: each.run.state.chain),
    "deque": (pl.Int64, lambda each: each.run.state.deque),
    "stack": (pl.Int64, lambda each: each.run.state.stack),
    "reconciling": (pl.Boolean, lambda each: each.run.state.reconciling),
    "idle": (pl.Boolean, lambda each: each.run.state.idle),
    "top": (pl.String, lambda each: each.run.state.top),
}

_BLOCK: Columns[HeldBlock] = {
    "holder": (pl.Int64, lambda each: each.holder),
    "place": (_NAME, lambda each: each.place),
    "position": (pl.Int64, lambda each: each.position),
    "agent": (pl.Int64, lambda each: each.block.agent_id),
    "timestamp_us": (pl.UInt64, lambda each: each.block.timestamp_us),
    "event_bytes": (pl.Int64, lambda each: len(each.block.event_bytes)),
    "block_hash": (pl.String, lambda each: each.block.block_hash),
    "chain_hash": (pl.String, lambda each: each.block.chain_hash),
}


def handler_runs_frame(archive: RunArchive) -> pl.DataFrame:
    """Return a table with one row for each handler run.

    - `agent`, `life` and `line` locate the row: agent ID, incarnation (from 1), and line number in the trace.
    - `t_s` is the time in mission seconds.
    - `handler`, `algorithm` (1 to 20) and `branch` describe the handler run.
    - `trigger` is `message`, `event`, `timer`, `local`, `operator` or `boot`. `subject` is the name of the message or
      timer, the ID of the event, and so on. `sender` is the agent that sent the message.
    - `operations` and `blocks` are lists of equal length: the changes (`complete`, `chain+`, `deque-` and so on) and
      the hashes of their blocks.
    - `sent` lists the names of the sent messages.
    - `chain`, `deque` and `stack` are lengths after the run. `reconciling`, `idle` and `top` (the top chain hash) are
      the state after the run.

    Raises RunDirectoryError if a trace is damaged, and MachineError if the extra `data` is not installed.
    """
    return _frame(archive.handler_runs(), _HANDLER_RUN)


def blocks_frame(archive: RunArchive) -> pl.DataFrame:
    """Return a table with one row for each block that an agent holds at the end.

    - `holder` is the agent that holds the block.
    - `place` is `chain`, `deque` or `stack`, and `position` counts from 0.
    - `agent` is the agent that completed the block.
    - `timestamp_us` is the time of its newest event in microseconds, and `event_bytes` the size of its event data.
    - `block_hash` and `chain_hash` are hexadecimal. `chain_hash` is null outside the chain.

    Raises MachineError if the extra `data` is not installed.
    """
    return _frame(archive.blocks(), _BLOCK)


def _frame(records: Iterator[Record], columns: Columns[Record]) -> pl.DataFrame:
    schema = {name: of_type for name, (of_type, _) in columns.items()}
    frames = [pl.DataFrame(schema=schema)]
    while batch := list(islice(records, BATCH)):
        values = {name: [value(each) for each in batch] for name, (_, value) in columns.items()}
        frames.append(pl.DataFrame(values, schema=schema))
    return pl.concat(frames)


def _sender(trigger: Trigger) -> int | None:
    return trigger.sender if isinstance(trigger, MessageTrigger) else None
