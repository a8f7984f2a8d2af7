"""Traces as steps to compare."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from harness.archive.trace_lines import Line


@dataclass(frozen=True)
class Step:
    """A handler run as two runs are compared by it; `t`, in mission seconds, and `line` only say where it is.

    `changes` are (operation, block), `sent` are (message, block), and a block is its name, None for no block.
    """

    life: int
    handler: str
    branch: str
    trigger: dict[str, int | str]
    changes: tuple[tuple[str, str], ...]
    sent: tuple[tuple[str, str | None], ...]
    t: float = field(compare=False)
    line: int = field(compare=False)

    @classmethod
    def of(cls, line: Line, names: Mapping[str, str]) -> "Step":
        """`names` are those of the blocks by hash; one that has none goes by the beginning of its hash."""
        run = line.parsed()
        return cls(
            line.life,
            run.handler,
            run.branch,
            run.trigger,
            tuple((operation, name(block, names)) for operation, block in run.changes),
            tuple((sent.message, sent.block and name(sent.block, names)) for sent in run.sent),
            run.t,
            line.number,
        )


def name(block_hash: str, names: Mapping[str, str]) -> str:
    return names.get(block_hash, block_hash[:12])


def completed_blocks(lines: Iterable[Line], agent_id: int) -> dict[str, str]:
    """Hash -> `<agent>.<ordinal>` of each block that the agent completed, in all its lives."""
    names: dict[str, str] = {}
    for line in lines:
        if b'"complete"' in line.text:
            for operation, block in line.parsed().changes:
                if operation == "complete":
                    names.setdefault(block, f"{agent_id}.{len(names) + 1}")
    return names
