"""Apply a protocol variant to the agents and to the reference implementation."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.archive.vocabulary import BRANCHES
from harness.checker.reference import algorithms
from harness.checker.reference.state import Handler
from harness.play.variant import Variant, core_in_force, load_variant, replaced


@contextmanager
def in_force(variant: Variant | Path | None) -> Iterator[Variant | None]:
    """Let the agents and the checker use a protocol variant, or the variant in a file, inside the context. If `variant`
    is None, they use the original protocol. Processes that are forked inside the context use the variant, too. Raises
    VariantError.
    """
    if variant is None:
        yield None
        return
    if isinstance(variant, Path):
        variant = load_variant(variant)
    tables: list[Any] = [
        algorithms.ON_MESSAGE,
        algorithms.ON_TIMER,
        algorithms.ON_LOCAL_EVENT,
        algorithms.HANDLERS,
    ]
    judged = {number: _with_run(change.run) for number, change in variant.reference.items()}
    branches = dict(BRANCHES)
    with core_in_force(variant), replaced(tables, judged):
        for name, handler in algorithms.HANDLERS.items():
            if handler.algorithm in variant.core:
                BRANCHES[name] |= frozenset(variant.core[handler.algorithm].branches)
        try:
            yield variant
        finally:
            BRANCHES.update(branches)


def _with_run(run: Callable[..., str]) -> Callable[[Handler], Handler]:
    return lambda handler: replace(handler, run=run)
