"""The generated vectors, and the file that carries them to others.

An agent with other settings is another agent. Its vectors are included if they differ from those of the default
settings.

The first line of the file describes the file. Each further line is one step: an input and the expected output. `after`
is the number of the preceding step, so a reader finds all steps of a mission by going back. `in` and `out` are lines of
virtual time (ucp/contract/CONTRACT.md): times are mission seconds, datagrams are in base64, and `timer` is the
instant at which the next timer ends, null if none runs. `says` and `sends` are the same in words.

Over UDP the agent's own blocks have other timestamps, and so other hashes: put in those that its export has. Their
names are 1.1, 1.2 and so on.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

from harness.conformance._reference_model import Outcome
from harness.conformance._state_space import VARIANTS, Pair, Step, Variant, explore, in_short
from harness.conformance._virtual_lines import Line, Writer


@dataclass(frozen=True)
class Vectors:
    """Of one variant of the settings: all steps, and those that count."""

    variant: Variant
    steps: Sequence[Step]
    wanted: Mapping[Pair, Step]

    @cached_property
    def by_pair(self) -> dict[Pair, Step]:
        return {step.pair: step for step in self.steps}


def generate(only: str | None = None) -> list[Vectors]:
    """The same at each call. `only`: a number or name of a handler, to whose branches the vectors are limited."""
    if only is None:
        return list(_all())
    return [
        replace(vectors, wanted={pair: step for pair, step in vectors.wanted.items() if is_of(step.outcome, only)})
        for vectors in _all()
    ]


@cache
def _all() -> tuple[Vectors, ...]:
    """Made once, for however many agents: it takes seconds."""
    usual: dict[Pair, tuple[object, ...]] = {}
    generated = []
    for variant in VARIANTS.values():
        steps = list(explore(variant))
        told = {step.pair: in_short(step.outcome) for step in steps}
        wanted = {step.pair: step for step in steps if usual.get(step.pair) != told[step.pair]}
        usual = usual or told
        generated.append(Vectors(variant, steps, wanted))
    return tuple(generated)


def is_of(outcome: Outcome, only: str) -> bool:
    return any(only in (str(run.algorithm), run.handler) for run in outcome.runs)


SCHEMA = "ucp-conformance-vectors/1"


def to_lines(generated: Sequence[Vectors]) -> Iterator[str]:
    """Lines of the file, each with its end; the same for the same vectors."""
    total = sum(len(vectors.wanted) for vectors in generated)
    yield _line(
        {
            "schema": SCHEMA,
            "vectors": total,
            "about": "ucp-harness conformance --write; see docs/reference/conformance.md",
        }
    )
    number = 0
    for vectors in generated:
        if not vectors.wanted:
            continue
        root = number = number + 1
        first = Writer(vectors.variant).first()
        yield _line({"step": root, "after": None, "settings": vectors.variant.name, "in": first, "out": None})
        numbers: dict[tuple[str, ...], int] = {(): root}
        for step in vectors.wanted.values():
            way = (*step.way, step.pair.input)
            known = next(length for length in range(len(way) - 1, -1, -1) if way[:length] in numbers)
            writer = Writer(vectors.variant)
            for _ in writer.lines(way[:known]):
                pass
            after = numbers[way[:known]]
            for length in range(known + 1, len(way) + 1):
                lines = list(writer.lines(way[length - 1 : length]))
                for place, line in enumerate(lines, 1):
                    number += 1
                    judged = length == len(way) and place == len(lines)
                    yield _line(_step(number, after, line, step.before.text if judged else None))
                    after = number
                numbers[way[:length]] = number


def _step(number: int, after: int, line: Line, state: str | None) -> dict[str, Any]:
    """`state` in words is there only of a vector, not of a step on the way to one."""
    runs = [{"algorithm": run.algorithm, "handler": run.handler, "branch": run.branch} for run in line.outcome.runs]
    step = {"step": number, "after": after, "input": line.name, "in": line.given, "out": line.answer}
    words = {"says": line.says, "sends": line.sends, "runs": runs}
    return {**step, **words, **({"vector": True, "state": state} if state is not None else {})}


def _line(document: dict[str, Any]) -> str:
    return json.dumps(document, separators=(",", ":")) + "\n"
