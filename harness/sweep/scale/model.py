"""What is asked: how many agents, for how long, at which loss, how often."""

import shlex
from collections.abc import Callable
from itertools import product
from typing import Annotated, NamedTuple, TypeVar

from pydantic import Field

from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario.agent_options import AgentCommand, Events
from harness.scenario.network import NetworkModel
from harness.scenario.scenario import Settle
from harness.scenario.strict_model import MAX_AGENTS, Model, Probability, Seconds
from harness.scenario.vehicles import Vehicles

MAX_SEEDS = 1000
MAX_MINUTES = 100_000.0

AGENTS, MINUTES, LOSS, SEEDS, SETTLE_MINUTES = "5,10,20,50,100", "10,20,40", "0.15", 3, 20.0
"""Unless asked otherwise: some four minutes on two cores."""

N = TypeVar("N", int, float)


class Size(NamedTuple):
    """Where a run stands in the sweep."""

    loss: float
    minutes: float
    agents: int


class Scale(Model):
    """Each number of `agents` flies for each of `minutes` at each `loss`, with the seeds 1 to `seeds`.

    Events are random (Algorithm 21). After the mission the agents have `settle_minutes` to finish.
    """

    agents: Annotated[list[Annotated[int, Field(ge=1, le=MAX_AGENTS)]], Field(min_length=1)]
    minutes: Annotated[list[Seconds], Field(min_length=1)]
    loss: Annotated[list[Probability], Field(min_length=1)]
    seeds: Annotated[int, Field(ge=1, le=MAX_SEEDS)] = SEEDS
    settle_minutes: Annotated[float, Field(gt=0, allow_inf_nan=False)] = SETTLE_MINUTES
    agent_command: AgentCommand = None

    @property
    def sizes(self) -> list[Size]:
        return [Size(*size) for size in product(self.loss, self.minutes, self.agents)]

    def scenario_at(self, size: Size) -> Scenario:
        return Scenario(
            name=f"{size.agents} agents, {size.minutes:g} minutes, loss {size.loss:g}",
            agents=size.agents,
            duration_s=60 * size.minutes,
            network=NetworkModel(loss=size.loss),
            events=Events(source="random"),
            vehicles=Vehicles(kind="none"),
            settle=Settle(limit_s=60 * self.settle_minutes),
            agent_command=self.agent_command,
        )


def read_request(
    agents: str, minutes: str, loss: str, seeds: int, settle_minutes: float, agent_command: str | None = None
) -> Scale:
    """From the command line, where lists have commas. Raises ScenarioError: one sentence with option and value."""
    _within("--seeds", str(seeds), 1 <= seeds <= MAX_SEEDS, f"a number of seeds is 1..{MAX_SEEDS}")
    allowed = f"minutes are more than 0 and at most {MAX_MINUTES:g}"
    _within("--settle", f"{settle_minutes:g}", 0 < settle_minutes <= MAX_MINUTES, allowed)
    return Scale(
        agents=_numbers(
            "--agents", agents, int, lambda number: 1 <= number <= MAX_AGENTS, f"a number of agents is 1..{MAX_AGENTS}"
        ),
        minutes=_numbers("--minutes", minutes, float, lambda number: 0 < number <= MAX_MINUTES, allowed),
        loss=_numbers("--loss", loss, float, lambda number: 0 <= number <= 1, "a loss is a probability 0..1"),
        seeds=seeds,
        settle_minutes=settle_minutes,
        agent_command=None if agent_command is None else _words(agent_command),
    )


def _words(command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ScenarioError(f"--agent-command {command!r} is no command: {error}") from None
    _within("--agent-command", repr(command), bool(words), "a command is a program and its arguments")
    return words


def _numbers(option: str, text: str, kind: type[N], possible: Callable[[N], bool], allowed: str) -> list[N]:
    """Ascending."""
    numbers: list[N] = []
    for word in (word.strip() for word in text.split(",")):
        try:
            number = kind(word)
        except ValueError:
            number = None
        _within(option, word or "empty", number is not None and possible(number), f"{allowed}, several have commas")
        if number in numbers:
            raise ScenarioError(f"{option} names {word} twice")
        assert number is not None
        numbers.append(number)
    return sorted(numbers)


def _within(option: str, given: str, possible: bool, allowed: str) -> None:
    if not possible:
        raise ScenarioError(f"{option} is {given}: {allowed}")
