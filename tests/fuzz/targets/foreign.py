"""Fuzz target: the answers of a foreign agent (a separate program) in a simulated swarm. The run must always end.

The foreign agent is the harness's own agent in this process, with some answers replaced. Each line of an input, such as
`{"n":5,"answer":{...}}`, replaces one answer by any JSON value. `n` is the index of the answer. It counts from 0 and
continues after a restart of the agent.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

from harness import checker
from harness.errors import HarnessError
from harness.play.simulation.foreign import _foreign_swarm, _program_pool, determinism
from harness.play.simulation.foreign.line_program import LineProgram
from harness.run.simulate import simulate
from harness.scenario import Scenario
from tests.fuzz.finding import require, sound
from tests.harness.virtual import scenario
from ucp.virtual import VirtualAgent

assert determinism.LineProgram is LineProgram, "it is imported here, so that it never takes the replacement for its own"
_REPLACED = re.compile(rb'\{"n":(\d{1,3}),"answer":(.*)\}')
SCENARIO: Scenario = scenario(
    agents=3,
    duration_s=30,
    network={"loss": 0.1},
    settings={"max_block_bytes": 64, "max_event_bytes": 64},
    events={"source": "scripted", "script": [{"at_s": at_s, "agent": at_s % 3 + 1, "bytes": 40} for at_s in range(9)]},
    timeline=[{"at_s": 20, "reboot": [2], "down_s": 3, "disk": "kept"}, {"at_s": 26, "reconcile": [2]}],
    agent_command={2: ["true"]},
    settle={"limit_s": 30},
)


class _OwnAgentProgram(LineProgram):
    """The harness's own agent without its own process. Some of its answers are replaced."""

    _agent: VirtualAgent
    answers: list[bytes]
    replaced: dict[int, bytes]

    def __init__(self, command: tuple[str, ...], log: Path | None = None) -> None:
        self.command, self.log, self.owes_an_answer = tuple(command), None, False
        self._received = b""

    @property
    def is_new(self) -> bool:
        return not self.answers

    @property
    def runs(self) -> bool:
        return True

    def write(self, line: bytes) -> None:
        given = json.loads(line)
        if "mission" in given:
            self._agent = VirtualAgent(given)
        else:
            self._agent.give(given)

    def read(self) -> bytes:
        good = self._agent.answer().encode() + b"\n"
        answer = self.replaced.get(len(self.answers), good)
        self.answers.append(good)
        return answer

    def log_phrase(self) -> str:
        return ""

    def last_line(self) -> str:
        return ""

    def clear_output(self) -> None:
        """Do nothing, because there is no output."""

    def end(self, within_s: float = 0.0) -> None:
        """Do nothing, because there is no process."""


def run(data: bytes) -> None:
    replaced = {int(match[1]): match[2] + b"\n" for line in data.split(b"\n") if (match := _REPLACED.fullmatch(line))}
    _play(replaced)


def _play(replaced: dict[int, bytes]) -> list[bytes]:
    """Play the scenario with some answers replaced. Return the answers that the agent gave before they were
    replaced.
    """
    ours = type("Replaced", (_OwnAgentProgram,), {"answers": [], "replaced": replaced})
    with (
        patch.object(_program_pool, "LineProgram", ours),
        patch.object(_foreign_swarm, "SHARED", _program_pool.ProgramPool()),
    ):
        try:
            played = simulate(SCENARIO, 1, tracing=True)
        except HarnessError as error:
            sound(str(error))
        else:
            require(played.played.outcome in ("completed", "failed"), f"it is {played.played.outcome}")
            sound(played.played.outcome_detail or "")
            _judge(played.result)
    return ours.answers  # type: ignore[attr-defined,no-any-return]


def _judge(result: checker.Result) -> None:
    for judgement in result.judgements.values():
        sound(judgement.reason)
        for finding in judgement.evidence:
            sound(finding.detail)
    for sentence in result.errors:
        sound(sentence)


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield correct answers of each kind."""
    kept, kinds = [], set[frozenset[bytes]]()
    for number, answer in enumerate(_play({})[:999]):
        kind = frozenset(re.findall(rb'"(?:handler|message|answer|store|schema)":"?\w*', answer))
        if kind not in kinds and len(answer) < 3000:
            kinds.add(kind)
            kept.append(b'{"n":%d,"answer":%s}' % (number, answer.strip()))
    for start in range(0, len(kept), 4):
        yield b"\n".join(kept[start : start + 4])
