"""Implement `ucp-harness diff`, which finds the first difference between two runs."""

import json
from collections.abc import Iterator
from pathlib import Path
from textwrap import shorten
from typing import Annotated, Any

import typer
from rich.text import Text

from harness.archive.archive import RunArchive
from harness.commands.terminal import complain, output, print_json
from harness.report.agent_programs import in_sentence
from harness.report.difference import AgentDifference, ComparedStep, FirstDifference, RunDifference, compare
from harness.run.provenance import differing_versions
from ucp.trigger import MessageTrigger, Trigger

DIFFERENT = 1
VALUE_CHARACTERS = 60
ONLY_REFERENCE_AGENTS = "all agents ran the harness's own program"


def diff_command(
    run_a: Annotated[Path, typer.Argument(help="First run directory.")],
    run_b: Annotated[Path, typer.Argument(help="Second run directory, with the same agents.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the differences as JSON.")] = False,
) -> None:
    """Find where two runs first differ.

    Exit status 0: the runs do not differ. 1: they differ.
    """
    difference = compare(run_a, run_b)
    differing = differing_versions(*(RunArchive(run).record.versions for run in (run_a, run_b)))
    if as_json:
        versions = {"differing_versions": differing}
        print_json({"a": str(run_a), "b": str(run_b), **difference.to_json(), **versions})
    else:
        console = output()
        for version in differing:
            console.print(Text(f"versions of A and B: {version}"), soft_wrap=True)
        for line in _lines(difference):
            console.print(Text(line), soft_wrap=True)
    for sentence in difference.errors:
        complain(sentence)
    if difference.verdict == "differ":
        raise typer.Exit(DIFFERENT)


def _lines(difference: RunDifference) -> Iterator[str]:
    """Yield the lines of the printed result. They call the first run A and the second run B."""
    for differing in difference.keys:
        yield f"{differing.key}: {_value(differing.a)} in A, {_value(differing.b)} in B"
    yield from _programs(difference)
    runs = f"{difference.handler_runs} handler runs of {len(difference.agents)} agents, and their chains"
    match difference.verdict:
        case "identical":
            yield f"identical to the last byte: {runs}"
        case "same but for times":
            differences = "times, in hashes that cover times, in tallies or in states"
            yield f"the same: {runs}; they differ only in {differences}, which are not compared"
        case _:
            yield from _differences(difference)


def _programs(difference: RunDifference) -> Iterator[str]:
    """Yield lines about the programs of the agents. Yield no line if all agents of both runs are the harness's own."""
    a, b = difference.programs["a"], difference.programs["b"]
    if a == b:
        yield from [f"in both runs {in_sentence(a)}"] if a else []
    else:
        yield from (f"in {run} {in_sentence(ran) or ONLY_REFERENCE_AGENTS}" for run, ran in (("A", a), ("B", b)))


def _differences(difference: RunDifference) -> Iterator[str]:
    first = difference.first
    if first is not None:
        first_difference = difference.agents[first].run
        assert first_difference is not None, "the first differing agent has a differing handler run"
        yield f"the runs differ first at {first_difference.at_s:.3f} s, at agent {first}"
    for agent_id, agent_difference in difference.agents.items():
        yield f"agent {agent_id}: {'the same' if agent_difference == AgentDifference(None, None) else ''}".rstrip()
        if agent_difference.run is not None:
            yield f"  differs from handler run {agent_difference.run.number} on"
            yield from (
                f"    {where}  {words}" for where, words in zip("AB", _step_texts(agent_difference.run), strict=True)
            )
        if agent_difference.chain is not None:
            a, b = (block or "not there" for block in (agent_difference.chain.a, agent_difference.chain.b))
            yield f"  block {agent_difference.chain.place} of its chain: {a} in A, {b} in B"


def _step_texts(first_difference: FirstDifference) -> tuple[str, str]:
    """Return the first handler run that differs in the two runs, as two texts. The texts contain changes and messages
    only if they differ.
    """
    a, b = first_difference.a, first_difference.b
    changes = a is None or b is None or a.changes != b.changes
    sent = a is None or b is None or a.sent != b.sent
    return _step(a, changes, sent), _step(b, changes, sent)


def _step(step: ComparedStep | None, changes: bool, sent: bool) -> str:
    if step is None:
        return "nothing more"
    incarnation = f"life {step.life}, " if step.life > 1 else ""
    words = f"{step.t:.3f} s (line {step.line}): {incarnation}{step.handler}, {step.branch}; {_trigger(step.trigger)}"
    if changes and step.changes:
        words += f"; {', '.join(' '.join(change) for change in step.changes)}"
    if sent and step.sent:
        words += f"; sends {', '.join(' '.join(filter(None, message)) for message in step.sent)}"
    return words


def _trigger(trigger: Trigger) -> str:
    """Return the trigger of a handler run as text, such as "Commit Block, number 17 of agent 4"."""
    if isinstance(trigger, MessageTrigger):
        return f"{trigger.message}, number {trigger.sequence} of agent {trigger.sender}"
    return ", ".join(f"{kind} {what}" for kind, what in trigger.to_json().items())


def _value(value: Any) -> str:
    return shorten(json.dumps(value, ensure_ascii=False), VALUE_CHARACTERS, placeholder=" …")
