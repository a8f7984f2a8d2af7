"""Generate the tests for all states and inputs of an agent, and write them to a file for use without the harness.

Agents with different settings have different vectors. The vectors for other settings are included if they differ from
those for the default settings.

The first line of the file describes the file. Each further line is one step: an input and the expected output. `after`
is the number of the step before this one. A program that follows these numbers backwards finds all steps of a mission.
`says` and `sends` contain the step as text. `in` and `out` are lines of virtual time (ucp/contract/CONTRACT.md):

- Times are mission seconds.
- Datagrams are in base64.
- `timer` is the time at which the next timer expires, or null if no timer runs.

Over UDP the agent's own blocks have different timestamps, and therefore different hashes. A reader must replace the
hashes of the blocks 1.1, 1.2 and so on by those in the agent's export.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

from harness.conformance._reference_model import ExpectedOutcome
from harness.conformance._state_space import (
    VARIANTS,
    AgentTransition,
    SettingsVariant,
    VectorKey,
    explore,
    handlers_and_messages,
)
from harness.conformance._virtual_agent import LineWriter, VirtualLine


@dataclass(frozen=True)
class VectorSet:
    """The generated tests for one combination of settings."""

    variant: SettingsVariant
    steps: Sequence[AgentTransition]
    """All transitions of the state space."""
    wanted: Mapping[VectorKey, AgentTransition]
    """The transitions that are tests. All other transitions only lead to the state of a test."""

    @cached_property
    def by_key(self) -> dict[VectorKey, AgentTransition]:
        return {step.key: step for step in self.steps}


def generate(only: str | None = None) -> list[VectorSet]:
    """Return all generated tests, or those in which one handler runs. Each call returns the same tests.

    `only` is the number of an Algorithm, or the name of its handler.
    """
    if only is None:
        return list(_all_sets())
    return [
        replace(vectors, wanted={key: step for key, step in vectors.wanted.items() if is_of(step.outcome, only)})
        for vectors in _all_sets()
    ]


@cache
def _all_sets() -> tuple[VectorSet, ...]:
    """Return all generated tests. Their computation takes seconds, so it happens only once for all tested agents."""
    default_results: dict[VectorKey, tuple[object, ...]] = {}
    generated = []
    for variant in VARIANTS.values():
        steps = list(explore(variant))
        expected = {step.key: handlers_and_messages(step.outcome) for step in steps}
        wanted = {step.key: step for step in steps if default_results.get(step.key) != expected[step.key]}
        default_results = default_results or expected
        generated.append(VectorSet(variant, steps, wanted))
    return tuple(generated)


def is_of(outcome: ExpectedOutcome, only: str) -> bool:
    return any(only in (str(run.algorithm), run.handler) for run in outcome.runs)


SCHEMA = "ucp-conformance-vectors/1"


def to_lines(generated: Sequence[VectorSet]) -> Iterator[str]:
    """Yield the lines of the file with all tests, including line ends. Equal tests always give equal lines."""
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
        first = LineWriter(vectors.variant).first_line()
        yield _line({"step": root, "after": None, "settings": vectors.variant.name, "in": first, "out": None})
        numbers: dict[tuple[str, ...], int] = {(): root}
        for step in vectors.wanted.values():
            path = (*step.path, step.key.input)
            known = next(length for length in range(len(path) - 1, -1, -1) if path[:length] in numbers)
            writer = LineWriter(vectors.variant)
            for _ in writer.lines(path[:known]):
                pass
            after = numbers[path[:known]]
            for length in range(known + 1, len(path) + 1):
                lines = list(writer.lines(path[length - 1 : length]))
                for place, line in enumerate(lines, 1):
                    number += 1
                    judged = length == len(path) and place == len(lines)
                    yield _line(_step(number, after, line, step.before.text if judged else None))
                    after = number
                numbers[path[:length]] = number


def _step(number: int, after: int, line: VirtualLine, state: str | None) -> dict[str, object]:
    """Return the JSON object for one input line.

    If the agent is tested after this line, `state` describes the state before it. Otherwise `state` is None.
    """
    runs = [{"algorithm": run.algorithm, "handler": run.handler, "branch": run.branch} for run in line.outcome.runs]
    step = {"step": number, "after": after, "input": line.name, "in": line.given, "out": line.answer}
    words = {"says": line.input_text, "sends": line.sent_texts, "runs": runs}
    return {**step, **words, **({"vector": True, "state": state} if state is not None else {})}


def _line(document: dict[str, Any]) -> str:
    return json.dumps(document, separators=(",", ":")) + "\n"
