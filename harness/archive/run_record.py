"""Define run.json, the record of one run (`ucp-run/1`). Later versions may add keys, but never remove or rename one.

The harness writes complete records. A record that it reads may come from a killed run or another version, or may be
edited. Each key of a `RunRecord` therefore has a default that stands for an unknown value.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from harness.backend_names import BackendName
from harness.scenario import Scenario, faults
from harness.scenario.agent_options import Stagger
from harness.scenario.expect import Expect
from harness.scenario.faults import DiskState
from harness.scenario.strict_model import Lateness, VehicleKey
from harness.scenario.verdict_names import FURTHER_CHECKS, CharacteristicVerdict, Verdict

SCHEMA = "ucp-run/1"

ENOUGH_ANSWERS = 20
"""Minimum number of answers. With fewer answers, the harness makes no statement about the times that agents took to
answer.
"""
TOLERATED_LATENESS_S = 0.05
"""Maximum acceptable lateness of deliveries on a shared channel, in mission seconds. For comparison: without a shared
channel, virtual time delivers messages after 2 to 50 ms.
"""


UNKNOWN_DRIFT = 1e-4
"""Assumed relative error of a clock whose rate could not be measured. Quartz clocks are more exact."""

AgentKey = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,4}$")]
"""The ID of an agent, or of its vehicle, as a JSON key."""


class _RecordModel(BaseModel):
    model_config = ConfigDict(extra="ignore", populate_by_name=True, allow_inf_nan=False, defer_build=True)


class FindingRecord(_RecordModel):
    """One piece of evidence of a judgement. `block` is the name of a block, such as 4.11."""

    agent_id: int
    detail: str
    block: str | None
    block_hash: str | None
    handler: str | None = None
    """The event handler that the evidence concerns. null if it concerns no handler."""


class CharacteristicRecord(_RecordModel):
    """The judgement on one of the six characteristics (Section 4.3)."""

    name: str
    verdict: CharacteristicVerdict
    reason: str
    evidence: list[FindingRecord]


class JudgementRecord(_RecordModel):
    """The judgement of one of the further checks: `steps`, `records` or `liveness`."""

    name: str
    verdict: Verdict
    reason: str
    evidence: list[FindingRecord]


class NetworkState(_RecordModel):
    """A description of the network from mission second `at_s` on.

    `what` names the change, and `detail` describes the state in words. `fully_connected` is true if the network has
    neither loss nor a partition.
    """

    at_s: float
    what: str
    detail: str
    fully_connected: bool
    planned_s: float | None = None
    """The mission second at which the scenario planned the change. null if the change was punctual."""


class FaultRecord(_RecordModel):
    """A change of the network, or a fault of agents, at mission second `at_s`. `detail` describes it in words."""

    at_s: float
    what: str
    detail: str
    fully_connected: bool | None = None
    agents: list[int] | None = None
    disk: DiskState | None = None
    """The state of the disk after a reboot."""
    by_hand: bool = False
    """True if a user requested the change or fault during the run. The timeline of the recorded scenario contains
    it.
    """
    planned_s: float | None = None
    """The mission second at which the scenario planned the change. null if the change was punctual."""

    @property
    def kind(self) -> type[faults.Fault]:
        """The Python class for this kind of fault."""
        return faults.fault_class(self.what)

    @property
    def loses_data(self) -> bool:
        """True if this fault made the agents lose all their data."""
        return self.kind.loses_data(self.disk)


class FinalReconcile(_RecordModel):
    """The final reconcile. `complete` is true if the last round of reconciles changed no chain."""

    at_s: float
    rounds: int
    complete: bool


class CycleStep(_RecordModel):
    """A handler run in a cycle, `after_s` mission seconds after the start of a period. `branch` is null if the traces
    do not contain the handler run.
    """

    agent_id: int
    after_s: float
    handler: str
    branch: str | None = None


class CycleWait(_RecordModel):
    """An agent that cannot finish. The agents in `for_agents` never answer the queries of this agent. The agents in
    `refused_by` disapprove the blocks of this agent.
    """

    agent_id: int
    for_agents: list[int] = []
    refused_by: list[int] = []
    """The agents that disapprove the blocks of the waiting agent. The list is also empty if no trace contains the
    votes.
    """


class Cycle(_RecordModel):
    """A sequence of handler runs that agents repeat forever. The repetition begins at mission second `since_s` or
    earlier.

    `period_s` is null for a standstill: no message is in transit, no timer runs, and `agents` are not idle. `proven` is
    true if the state of the whole swarm recurs and no random draw can change this. Otherwise the same handler runs
    occurred `periods` times in a row.
    """

    since_s: float
    period_s: float | None = None
    periods: int | None = None
    proven: bool = False
    agents: Annotated[list[int], Field(min_length=1)]
    """The agents in the cycle, including agents that are idle for a time. In a standstill, these are the agents that
    are not idle.
    """
    steps: list[CycleStep] = []
    """The handler runs of one period, in order."""
    waits: list[CycleWait] = []


class HandlerRuns(_RecordModel):
    """The number of handler runs in one incarnation, as the agent reported it at some time between `from_s` and
    `until_s`. `from_s` and `until_s` are equal if the agent reported its mission time together with the number.
    """

    counted: int
    from_s: float
    until_s: float


class AgentFailure(_RecordModel):
    """An error that ended an incarnation of an agent in virtual time. The run went on without the agent. `incarnation`
    counts from 1, and `detail` completes a sentence that starts with "agent 3".
    """

    at_s: float
    incarnation: int
    detail: str


class AgentRecord(_RecordModel):
    """The record of one agent. Its `outcome` is one of: exported, not exported, killed, rebooting, crashed, hung,
    broken, not supported, paused, running, not started.

    Counters are sums over all incarnations of the agent. An unknown counter is null.
    """

    outcome: str
    detail: str | None = None
    command: list[str] | None = None
    """The command of the agent without the mission file. null for an agent that runs inside the harness."""
    version: str | None = None
    """The name and version that the agent reported in its status."""
    restarts: int = 0
    """Number of restarts with the inception block only."""
    reboots: int = 0
    """Number of restarts with the data on its disk."""
    completed_before: list[str] = []
    """Hashes of the blocks that the agent completed in incarnations without an export. Such an incarnation was
    killed.
    """
    left_behind: list[str] = []
    """Names of the processes that were still running after the end of the agent. The harness ended them."""
    idle: bool | None = None
    reconciles: int | None = None
    chain_changed_at_s: float | None = None
    messages_sent: int | None = None
    bytes_sent: int | None = None
    dropped: dict[str, int] | None = None
    send_failures: int | None = None
    trace_problem: str | None = None
    handler_runs: list[HandlerRuns | None] = []
    """The agent's last report in each incarnation. null for an incarnation without a report."""
    failures: list[AgentFailure] = []


class CapturedFrames(_RecordModel):
    """The number of frames at the interface of a vehicle (`received`), and the number of these frames that its capture
    lacks (`dropped`).
    """

    received: int
    dropped: int


class ChannelLateness(_RecordModel):
    """How late the process of a shared channel delivered messages, in mission seconds."""

    deliveries: int
    median_s: float
    p95_s: float
    """Lateness that one in twenty deliveries exceeded."""
    most_s: float
    by_interval_s: list[float]
    """The greatest lateness of a delivery in each interval. The intervals are those of the key `load` of the
    channel.
    """
    missed: int
    """Number of broadcasts that the process did not receive, because its buffer was full."""
    unsent: int
    """Number of deliveries that the kernel did not accept."""
    processor_s: float
    """Processor time of the process, in seconds."""

    @property
    def tolerable(self) -> bool:
        """True if no delivery is missing and at least 95 % of the deliveries were at most
        `TOLERATED_LATENESS_S` late.
        """
        return self.p95_s <= TOLERATED_LATENESS_S and not self.missed and not self.unsent

    def in_words(self) -> str:
        """Return a sentence about late and missing deliveries."""
        late = (
            f"One in twenty messages arrived {self.p95_s:.2g} s or more late, and the latest {self.most_s:.2g} s late"
        )
        missing = f"; {self.missed} broadcasts and {self.unsent} deliveries are missing"
        return f"{late}{missing if self.missed or self.unsent else ''}"


class AnswerTimes(_RecordModel):
    """The times that agents took from the arrival of a query to their answer, in mission seconds."""

    count: int
    median_s: float
    p95_s: float
    """Time that one in twenty answers exceeded."""


class ChannelRecord(_RecordModel):
    """The frames on a radio channel that all vehicles shared. `model` contains the preset and all parameters of the
    radio.
    """

    model: dict[str, Any]
    frames: int
    """Number of frames that were sent."""
    airtime_s: float
    """Sum of the durations of all frames."""
    lost: dict[str, dict[AgentKey, int]]
    """Reason -> receiver -> number of frames that the receiver lost. Reasons: collision, half_duplex, fade, range,
    partition.
    """
    dropped: dict[str, dict[AgentKey, int]]
    """Reason -> sender -> number of messages that the sender's radio did not send. Reasons: queue, too_long."""
    load_interval_s: Annotated[float, Field(gt=0)]
    load: list[float]
    """The load of the channel: for each interval from mission second 0 on, the share of the time in which at least one
    frame was on the air.
    """
    lateness: ChannelLateness | None = None
    """Lateness of deliveries on the shared channel. null in virtual time, where each message arrives at its exact time.
    """
    answers: AnswerTimes | None = None
    """Times of answers. null in virtual time, where agents answer at once."""

    FRAMES: ClassVar[str] = "frames"

    def counts(self) -> Counter[tuple[str, int]]:
        """Return all counts of the channel: the number of sent frames under the key (FRAMES, 0), and each number of
        losses under its key (reason, vehicle).
        """
        counts = Counter({(self.FRAMES, 0): self.frames})
        for reason, by_vehicle in (*self.lost.items(), *self.dropped.items()):
            counts.update({(reason, int(vehicle)): count for vehicle, count in by_vehicle.items()})
        return counts

    def total(self, reason: str) -> int:
        """Return the number of frames or messages that were lost for this reason."""
        return sum((self.lost.get(reason) or self.dropped.get(reason, {})).values())


class ReceiverCounters(_RecordModel):
    """Numbers of packets to one vehicle: packets that the kernel passed, packets that it lost, and packets cut off by a
    partition. The JSON object also contains the network conditions that were applied.
    """

    model_config = ConfigDict(extra="allow")

    passed: int | None = None
    lost: int | None = None
    cut: int | None = None


class Counters(_RecordModel):
    """The packet counters of the kernel for each receiver."""

    model_config = ConfigDict(extra="allow")

    receivers: dict[AgentKey, ReceiverCounters] = {}


class DatagramsRead(_RecordModel):
    """The UDP datagrams in the network of a vehicle, as the kernel counted them over the whole run.

    `broadcasts` is the number of broadcasts that arrived, including the agent's own broadcasts. `read` is the number of
    datagrams that programs read, and `before_start` the number of them that were read before the mission began. The
    kernel discarded `overflowed` datagrams because the buffer of their socket was full, and `unreachable` datagrams
    because no socket was open. `others` is the number of datagrams that were not broadcasts.
    """

    read: int
    before_start: int
    overflowed: int
    unreachable: int
    broadcasts: int
    others: int = 0


class CutOff(_RecordModel):
    """The mission seconds in which a remote agent was cut off. `until_s` is null if it did not return."""

    from_s: float
    until_s: float | None = None


class RemoteRecord(_RecordModel):
    """An agent on another computer, with the measured clock of that computer and the delay of the connection. Times
    are in seconds of wall time, except those in `cut_off`. null means unknown. The measurements are of the agent's last
    incarnation.
    """

    host: str
    """Address from which the agent joined last."""
    worker: str | None = None
    """Address of the Dask worker that ran the agent. null if a user let the agent join."""
    command: list[str] = []
    """Command of the agent on that computer."""
    joins: int = 0
    """Number of connections. Each incarnation of the agent has its own."""
    epoch_us: int | None = None
    """Mission second 0 in the time of that computer's clock."""
    offset_s: float | None = None
    """Time by which the clock of that computer was ahead of the harness's clock."""
    uncertainty_s: float | None = None
    """Maximum error of `offset_s`: half of the shortest round trip."""
    drift: float | None = None
    """Relative error of the rate of that computer's clock."""
    delay_s: float | None = None
    """Delay of the connection in one direction: half of the median round trip."""
    delay_p95_s: float | None = None
    """The 95 % quantile of the delay: one delay in twenty was longer."""
    delay_most_s: float | None = None
    """Longest delay in all incarnations."""
    pings: int = 0
    """Number of measured round trips."""
    cut_off: list[CutOff] = []
    lost: int = 0
    """Number of datagrams of the agent that did not reach the lab, because the vehicle was cut off."""
    incomplete: list[int] = []
    """Numbers of the incarnations whose end is not on record, because the vehicle was cut off. The first incarnation
    is 1. The last lines of these incarnations are missing in the trace.
    """

    @property
    def lack(self) -> str | None:
        """A phrase that names the incarnations whose end is not on record, or None if there are none."""
        if not self.incomplete:
            return None
        if len(self.incomplete) == 1:
            return f"the end of incarnation {self.incomplete[0]} is not on record, because the vehicle was cut off"
        numbers = ", ".join(map(str, self.incomplete))
        return f"the ends of incarnations {numbers} are not on record, because the vehicle was cut off"

    def clock_error_s(self, lasted_s: float) -> float:
        """Return the maximum difference between the mission times of the agent and of the harness, in seconds of wall
        time, in a run that lasted `lasted_s` seconds.

        The result includes the delay of the connection, because a fault reaches the agent with this delay.
        """
        drift = UNKNOWN_DRIFT if self.drift is None else abs(self.drift)
        return (self.uncertainty_s or 0.0) + drift * lasted_s + (self.delay_most_s or 0.0)


class BlockHolders(_RecordModel):
    """The vehicles that held a block directly after a loss of vehicles (`holders`), and those that held it at the end
    of the run. Agent `agent_id` completed the block.
    """

    block: str
    block_hash: str
    agent_id: int
    holders: list[int]
    holders_at_end: list[int]


class Loss(_RecordModel):
    """The loss of vehicles with all their data at mission second `at_s`. Numbers of blocks are null if traces are
    missing.

    `completed` is the number of blocks that all agents had completed. Of these, `survived` is the number of blocks that
    another vehicle held, and `gone` is the number that only the lost vehicles held. `gone_at_end` is the number of
    blocks that no vehicle holds at the end of the run, for any reason.
    """

    at_s: float
    what: str
    vehicles: list[int]
    completed: int | None = None
    survived: int | None = None
    gone: int | None = None
    gone_at_end: int | None = None
    blocks: list[BlockHolders] = []
    """Blocks that the lost vehicles completed, and blocks that are gone, oldest first."""


class LeastHeld(_RecordModel):
    """The holders of the block that the fewest vehicles hold. If all these holders were lost, the block would be
    lost.
    """

    vehicles: int
    """Number of vehicles that could hold the block."""
    holders: list[int]
    block: str
    block_hash: str
    blocks: int
    """Number of blocks with this smallest number of holders."""
    of: int
    """Number of all blocks in the comparison."""


class Survival(_RecordModel):
    """The survival of blocks when vehicles are lost. `completed` is the number of all blocks, and `gone` is the number
    of blocks that no vehicle holds at the end.

    Both are null if the completed blocks of some agents are unknown.
    """

    losses: list[Loss] = []
    completed: int | None
    gone: int | None
    at_end: LeastHeld | None = None
    before_final_reconcile: LeastHeld | None = None


class InjectedMessages(_RecordModel):
    """The messages of one type in an injection: their number, and the handler runs that they caused.

    `handled` maps each branch of the handler to its number of runs. `changed` is the number of runs that changed the
    data of an agent. `unhandled` is the number of messages without a handler run. It is null if traces contain unknown
    names of messages.
    """

    message: str
    sent: int
    handled: dict[str, int] = {}
    changed: int = 0
    unhandled: int | None = 0


class RogueInjection(_RecordModel):
    """The effect of one injection. `refused` contains the numbers of datagrams that are not valid messages, by reason.
    Agents drop such datagrams and count them. `untraced` is the number of copies that are missing in `messages`,
    because traces do not distinguish these copies from the originals.
    """

    at_s: float
    what: str
    detail: str
    sent: int = 0
    bytes: int = 0
    messages: list[InjectedMessages] = []
    refused: dict[str, int] = {}
    untraced: int = 0


WRITTEN_FROM_THE_START = ("scenario", "seed", "backend", "versions", "started_at")


class JudgedRecord(_RecordModel):
    """The part of the record of a run that the checker needs."""

    schema_: Literal["ucp-run/1"] = Field(default="ucp-run/1", alias="schema")
    roster: list[int]
    outcome: Literal["running", "completed", "interrupted", "failed", "not supported"] = "running"
    """The outcome of the run. With `not supported`, an agent does not support a feature that the run needs, and the run
    is not judged.
    """
    outcome_detail: str | None = None
    network: list[NetworkState] = []
    faults: list[FaultRecord] = []
    final_reconcile: FinalReconcile | None = None
    cycle: Cycle | None = None
    """A cycle that shows that the agents never finish. If the cycle is `proven`, the harness ended the run when it
    found the cycle.
    """
    mission_s: float | None = None
    stagger: Annotated[Stagger, Field(exclude=True)] = {}
    """The key `stagger` of the scenario: the differences between the timers of agents."""
    lateness: Annotated[dict[VehicleKey, Lateness], Field(exclude=True)] = {}
    """The key `lateness` of the scenario: agents with late timers in virtual time."""
    agents: dict[AgentKey, AgentRecord] = {}
    engine: str | None = None
    counters: Counters | None = None
    datagrams: dict[AgentKey, DatagramsRead] = {}
    """Datagrams that each agent read. An agent is missing if another program on its vehicle uses UDP."""
    channel: ChannelRecord | None = None
    """The frames on the shared channel. null without a shared channel."""
    remote: dict[AgentKey, RemoteRecord] = {}
    """Agents on other computers."""

    @property
    def switched_off(self) -> dict[int, float]:
        """The agents that exported their chains and ended before the end of the run, each with the mission second of
        its end.
        """
        off = (fault for fault in self.faults if fault.kind.exports_chain)
        return {agent_id: fault.at_s for fault in off for agent_id in fault.agents or ()}

    def end_of(self, agent_id: int) -> float | None:
        """Return the mission second at which the agent ended. Return None if the record does not contain it."""
        return self.switched_off.get(agent_id, self.mission_s)


class OperatorCommand(_RecordModel):
    """A command of an operator. It was first sent at mission second `at_s` and last at `until_s`, in total `times`
    times. `values` contains the fields of the message.
    """

    at_s: float
    until_s: float
    times: int = 1
    vehicles: list[int]
    message: str
    command: str | None = None
    """Name of the MAV_CMD in a COMMAND_LONG or COMMAND_INT. None for other messages."""
    values: dict[str, Any] = {}


class GroundStationRecord(_RecordModel):
    """Numbers of datagrams between the vehicles and a ground station. `dropped` is the number of datagrams that were
    damaged or exceeded the limit.
    """

    address: str
    sent: int = 0
    received: int = 0
    dropped: int = 0
    commands: list[OperatorCommand] = []
    commands_left_out: int = 0
    """Number of commands that the record omits, because it has a maximum number of commands."""


class RunRecord(JudgedRecord):
    """The record of a run. Times are mission seconds, except `wall_s` in seconds of wall time. Unknown values are null
    or empty."""

    model_config = ConfigDict(json_schema_extra={"required": ["roster", *WRITTEN_FROM_THE_START]})

    roster: list[int] = []
    scenario: Scenario | None = None
    seed: int | None = None
    backend: BackendName | None = None
    versions: dict[str, str] = {}
    all_delivered: bool = False
    """True if virtual time also delivered messages without effect, for example because of `--watch`. The traces then
    contain these messages.
    """
    started_at: str | None = None
    wall_s: float | None = None
    settled: bool = False
    vehicles: dict[AgentKey, dict[str, Any]] = {}
    unmatched_fates: list[str] = []
    """A sentence for each scripted fate without a matching message, each injection that sent nothing, and each vehicle
    that did not simulate a fault."""
    keys_fingerprint: str | None = None
    """Fingerprint of the public keys of a secured mission. null if the mission was not secured."""
    capture: dict[AgentKey, CapturedFrames] | None = None
    """The frames of each vehicle. null if no captures were requested or they were not completed."""
    ground_station: GroundStationRecord | None = None
    """The traffic with the ground station. null without a ground station."""
    characteristics: dict[str, CharacteristicRecord] = {}
    steps: JudgementRecord | None = None
    """The judgement on the comparison of each handler run with the reference."""
    records: JudgementRecord | None = None
    """The judgement on the comparison of records that describe the same facts."""
    liveness: JudgementRecord | None = None
    """The judgement on liveness: whether the swarm became idle after the last event."""
    figures: dict[str, float | int | None] = {}
    survival: Survival | None = None
    rogue: list[RogueInjection] = []
    """The effect of each injection of the timeline, in order."""
    errors: list[str] = []
    """A sentence for each file that the checker could not read completely."""

    @model_validator(mode="after")
    def _copy_timers_of_scenario(self) -> "RunRecord":
        if self.scenario is not None:
            self.stagger, self.lateness = self.scenario.stagger, self.scenario.lateness
        return self

    @property
    def known_agents(self) -> list[int]:
        """The IDs of all agents in the record in ascending order, including agents without files."""
        requested = self.scenario.roster if self.scenario else ()
        return sorted({*self.roster, *requested, *map(int, self.agents), *map(int, self.vehicles)})

    def late_answers(self) -> str | None:
        """Return a sentence if agents took longer to answer than the shared channel assumes. Otherwise return None."""
        answers = self.channel.answers if self.channel else None
        model = self.scenario.network.channel if self.scenario else None
        if self.scenario is None or model is None or answers is None or answers.count < ENOUGH_ANSWERS:
            return None
        if answers.p95_s <= model.processing_s + self.scenario.settings.answer_spread_s:
            return None
        return (
            f"One in twenty answers left its agent {answers.p95_s:.2g} s or more after the question arrived, but "
            f"`processing_s` is {model.processing_s:g} s, so fewer answers collided than with a processor for each "
            "agent"
        )

    @property
    def expect(self) -> Expect:
        """The expected results in the scenario. It is empty if the scenario has none."""
        return (self.scenario and self.scenario.expect) or Expect()

    def unmet_expectations(
        self, chains: Mapping[int, Sequence[str]], top_chain_hashes: Mapping[int, str]
    ) -> Iterator[tuple[str, list[str]]]:
        """Yield each kind of expectation except verdicts, with a sentence for each unmet expectation of this kind.
        `chains` contains the block hashes of each agent's chain. `top_chain_hashes` contains the top chain hash of each
        agent.
        """
        found = [(finding.agent_id, finding.handler) for finding in (self.steps.evidence if self.steps else ())]
        figures: dict[str, float | None] = {name: self.figures.get(name) for name in self.expect.figures}
        return self.expect.unmet(figures, chains, top_chain_hashes, found)

    @property
    def judgements(self) -> dict[str, CharacteristicRecord | JudgementRecord]:
        """The judgements on the characteristics by number, and the judgements of all other checks by key."""
        further = {key: judgement for key in FURTHER_CHECKS if (judgement := getattr(self, key)) is not None}
        return {**self.characteristics, **further}

    def to_json(self) -> dict[str, object]:
        """Return the record as a JSON object with all keys."""
        return self.model_dump(mode="json", by_alias=True)
