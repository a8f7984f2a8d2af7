"""Define the lines of `lag.jsonl` and `channel.jsonl`.

`lag.jsonl` contains the measured delays with which the machine woke programs during a run, and the load of each agent's
processes. `harness/play/process/_lag_probe.py` writes this file. `channel.jsonl` is the log of a shared radio channel.
Each line describes a message that a radio sent or dropped.
"""

from bisect import bisect_left
from collections import defaultdict
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.run_record import AgentKey

LAG_FILE = "lag.jsonl"

_Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class LagLine(BaseModel):
    """A line of `lag.jsonl` about the mission seconds `from_s` to `until_s`. The measured times are in seconds of wall
    time.

    `machine_s` is the greatest delay with which the machine woke a program, plus the time that programs waited for a
    disk or the hypervisor. `busy_s` is, for each agent, the time during which its processes ran or waited for a
    processor. Agents without processes are not included.
    """

    model_config = ConfigDict(extra="ignore", defer_build=True)

    from_s: Annotated[float, Field(allow_inf_nan=False)]
    until_s: Annotated[float, Field(allow_inf_nan=False)]
    machine_s: _Seconds
    busy_s: dict[AgentKey, _Seconds]
    computer_of: AgentKey | None = None
    """The ID of a remote agent. The line describes the computer of this agent. If the computer runs several agents,
    `busy_s` has a key for each of them. null for the machine of the harness.
    """


class MeasuredLag:
    """The delays of the machine and the agents that were measured over the whole run."""

    def __init__(self, lines: list[LagLine]) -> None:
        self._lines: dict[AgentKey | None, list[LagLine]] = defaultdict(list)
        for line in sorted(lines, key=lambda line: line.until_s):
            self._lines[line.computer_of].append(line)
        self._computer_of = {
            agent: line.computer_of
            for line in lines
            if line.computer_of is not None
            for agent in (line.computer_of, *line.busy_s)
        }
        self._ends = {computer: [line.until_s for line in lines] for computer, lines in self._lines.items()}

    def explains(self, agent_id: int, from_s: float, until_s: float) -> float | None:
        """Return the delays of the machine and of the agent that were measured between `from_s`, when a timer expired,
        and `until_s`, when its handler ran. The result is their sum, in seconds of wall time.

        Return None if the delays were not measured during all of this time.
        """
        agent = str(agent_id)
        computer = self._computer_of.get(agent)
        ends = self._ends.get(computer, [])
        lines = self._lines[computer][bisect_left(ends, from_s) : bisect_left(ends, until_s) + 1]
        if not lines or lines[0].from_s > from_s or lines[-1].until_s < until_s:
            return None
        if any(agent not in line.busy_s for line in lines):
            return None
        return sum(line.machine_s + line.busy_s[agent] for line in lines)


CHANNEL_FILE = "channel.jsonl"

Reason = Annotated[str, Field(max_length=20)]


class ChannelLine(BaseModel):
    """One message on the shared channel: its receivers and losses. `sequence` is the sequence number of the message, or
    None for a datagram that is not a message of the vehicle's agent.
    """

    model_config = ConfigDict(strict=True, defer_build=True)

    sender: int
    sequence: int | None
    lost: dict[Reason, list[int]] = {}
    """Reason -> vehicles that lost the message."""
    dropped: Reason | None = None
    """The reason why the radio did not send the message. None if it was sent."""
