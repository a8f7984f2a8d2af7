"""What run.json says: the record of one run, schema `ucp-run/1`. Keys are added, never removed or renamed.

The harness writes all of it. What is read back may be of a run that was killed, of another version, or edited: there
is a default for every key of a `RunRecord`, which says that nothing is known of it.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from harness.backend_names import BackendName
from harness.scenario import Scenario, faults
from harness.scenario.agent_options import Stagger
from harness.scenario.faults import Disk
from harness.scenario.verdict_names import BESIDE, CharacteristicVerdict, Verdict

SCHEMA = "ucp-run/1"


AgentKey = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,4}$")]
"""An agent's ID, or that of its vehicle, where JSON has text for keys."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="ignore", populate_by_name=True, allow_inf_nan=False)


class FindingRecord(_Model):
    """One piece of evidence; `block` is its name for people, such as 4.11."""

    agent_id: int
    detail: str
    block: str | None
    block_hash: str | None
    handler: str | None = None
    """The event handler that did it, if one did."""


class CharacteristicRecord(_Model):
    """The judgement on one of the six characteristics."""

    name: str
    verdict: CharacteristicVerdict
    reason: str
    evidence: list[FindingRecord]


class JudgementRecord(_Model):
    """A judgement beside the characteristics."""

    name: str
    verdict: Verdict
    reason: str
    evidence: list[FindingRecord]


class NetworkState(_Model):
    """From mission second `at_s` on, `detail` holds; `fully_connected` means that nothing is lost or cut."""

    at_s: float
    what: str
    detail: str
    fully_connected: bool


class FaultRecord(_Model):
    """What a scenario did to the network or to agents at `at_s`; `detail` says it to people."""

    at_s: float
    what: str
    detail: str
    fully_connected: bool | None = None
    agents: list[int] | None = None
    disk: Disk | None = None
    """What a reboot left of it."""
    by_hand: bool = False
    """Somebody asked for it while the run went on; the scenario's timeline has it since."""

    @property
    def kind(self) -> type[faults.Fault]:
        """What is known of such faults."""
        return faults.named(self.what)

    @property
    def loses_data(self) -> bool:
        """Whether all that the agents held was gone."""
        return self.kind.loses_data(self.disk)


class FinalReconcile(_Model):
    """`complete` once a round of reconciles changed no chain."""

    at_s: float
    rounds: int
    complete: bool


class CycleStep(_Model):
    """So long after the cycle begins anew, an agent runs this handler; `branch` is None if that was not traced."""

    agent_id: int
    after_s: float
    handler: str
    branch: str | None = None


class CycleWait(_Model):
    """An agent asks in each reconcile of the cycle, and these never answer; those refuse its blocks."""

    agent_id: int
    for_agents: list[int] = []
    refused_by: list[int] = []
    """Empty, too, where that was not traced."""


class Cycle(_Model):
    """What agents that never finish go round in, at the latest since mission second `since_s`.

    `period_s` is None of a standstill: nothing is on its way, no timer runs, and `agents` are not done. `proven`: the
    global state recurs, and nothing is left to chance; otherwise the same handler runs were seen `periods` times in a
    row.
    """

    since_s: float
    period_s: float | None = None
    periods: int | None = None
    proven: bool = False
    agents: Annotated[list[int], Field(min_length=1)]
    """Those that go round, of whom some may be idle at any moment; of a standstill those that are not idle."""
    steps: list[CycleStep] = []
    """One period, in order."""
    waits: list[CycleWait] = []


class HandlerRuns(_Model):
    """How many handler runs an agent had counted in one life, by a moment between `from_s` and `until_s`.

    They are the same if it told its own mission time with it.
    """

    counted: int
    from_s: float
    until_s: float


class AgentRecord(_Model):
    """`outcome` is exported, not exported, killed, rebooting, crashed, hung, broken, not supported, paused, running or
    not started.

    Counters are those of all its lives, if it had more than one, and null if unknown.
    """

    outcome: str
    detail: str | None = None
    command: list[str] | None = None
    """What started it, but for its mission file; null of one that ran inside the harness."""
    version: str | None = None
    """What it said of itself in its status."""
    restarts: int = 0
    """How often it began anew with nothing."""
    reboots: int = 0
    """How often it came back with what was on its disk."""
    completed_before: list[str] = []
    """Hashes of the blocks that it completed in lives that left no export, since it was killed."""
    idle: bool | None = None
    reconciles: int | None = None
    chain_changed_at_s: float | None = None
    messages_sent: int | None = None
    bytes_sent: int | None = None
    dropped: dict[str, int] | None = None
    send_failures: int | None = None
    trace_problem: str | None = None
    handler_runs: list[HandlerRuns | None] = []
    """What it said last in each of its lives; null of a life in which it said nothing."""


class CapturedFrames(_Model):
    """How many frames crossed a vehicle's interface, and how many of them its capture lacks."""

    received: int
    dropped: int


class ReceiverCounters(_Model):
    """How many packets to a vehicle the kernel let through, lost, and cut off; and what it was told to do to them."""

    model_config = ConfigDict(extra="allow")

    passed: int | None = None
    lost: int | None = None
    cut: int | None = None


class Counters(_Model):
    """What the kernel counted, by receiver."""

    model_config = ConfigDict(extra="allow")

    receivers: dict[AgentKey, ReceiverCounters] = {}


class BlockHolders(_Model):
    """Who held a block right after vehicles were lost, and at the end; `agent_id` completed it."""

    block: str
    block_hash: str
    agent_id: int
    holders: list[int]
    holders_at_end: list[int]


class Loss(_Model):
    """Vehicles were lost at `at_s`, and all that they held with them. Counts are null where traces are missing.

    Of the blocks `completed` by then, by anybody, `survived` are those that some other vehicle held, `gone` those that
    only the lost ones did, and `gone_at_end` those that nobody holds at the end, whatever took them.
    """

    at_s: float
    what: str
    vehicles: list[int]
    completed: int | None = None
    survived: int | None = None
    gone: int | None = None
    gone_at_end: int | None = None
    blocks: list[BlockHolders] = []
    """Those that the lost vehicles had completed, and those that are gone; the oldest first."""


class LeastHeld(_Model):
    """The smallest set of vehicles whose loss would lose a block: the holders of the block that the fewest hold."""

    vehicles: int
    """How many there are to hold it."""
    holders: list[int]
    block: str
    block_hash: str
    blocks: int
    """How many blocks are on as few vehicles."""
    of: int
    """How many blocks there are."""


class Survival(_Model):
    """What became of the `completed` blocks where vehicles were lost; `gone` are on no vehicle at the end.

    None where nothing tells what some agents completed.
    """

    losses: list[Loss] = []
    completed: int | None
    gone: int | None
    at_end: LeastHeld | None = None
    before_final_reconcile: LeastHeld | None = None


class InjectedMessages(_Model):
    """Of one injection the messages of one type: how many it sent, and what the agents that heard them did.

    `handled`: branch of the handler -> how often it was taken. `changed`: how many of these handler runs changed what
    an agent holds. `unhandled`: how many of the messages no agent handled; None if traces name messages otherwise.
    """

    message: str
    sent: int
    handled: dict[str, int] = {}
    changed: int = 0
    unhandled: int | None = 0


class RogueInjection(_Model):
    """What became of one injection. `refused`: datagrams that are no message, by reason; agents only count them.

    `untraced` are copies that are not told from the others.
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


class JudgedRecord(_Model):
    """The part of a record that a judgement of the run needs."""

    schema_: Literal["ucp-run/1"] = Field(default="ucp-run/1", alias="schema")
    roster: list[int]
    outcome: Literal["running", "completed", "interrupted", "failed", "not supported"] = "running"
    """Not supported: an agent said that it lacks what the run needs, and nothing is judged."""
    outcome_detail: str | None = None
    network: list[NetworkState] = []
    faults: list[FaultRecord] = []
    final_reconcile: FinalReconcile | None = None
    cycle: Cycle | None = None
    """Where agents were shown never to finish; if `proven`, the run stopped there."""
    mission_s: float | None = None
    stagger: Annotated[Stagger, Field(exclude=True)] = {}
    """As the scenario has it: by how much agents were told different timers."""
    agents: dict[AgentKey, AgentRecord] = {}
    engine: str | None = None
    counters: Counters | None = None

    @property
    def switched_off(self) -> dict[int, float]:
        """Agents that ended in order before the run did, and when, in mission seconds: their exports are of then."""
        off = (fault for fault in self.faults if fault.kind.leaves_an_export)
        return {agent_id: fault.at_s for fault in off for agent_id in fault.agents or ()}

    def end_of(self, agent_id: int) -> float | None:
        """When the run ended for this agent, in mission seconds; None if it is not on record."""
        return self.switched_off.get(agent_id, self.mission_s)


class OperatorCommand(_Model):
    """What an operator sent at `at_s`, `times` times in a row until `until_s`; `values` are the message's fields."""

    at_s: float
    until_s: float
    times: int = 1
    vehicles: list[int]
    message: str
    command: str | None = None
    """The MAV_CMD of a COMMAND_LONG or COMMAND_INT."""
    values: dict[str, Any] = {}


class GroundStationRecord(_Model):
    """What passed between the vehicles and a ground station, in datagrams; `dropped` ones were too many, or damaged."""

    address: str
    sent: int = 0
    received: int = 0
    dropped: int = 0
    commands: list[OperatorCommand] = []
    commands_left_out: int = 0
    """Of which there were more than are kept."""


class RunRecord(JudgedRecord):
    """All of a record. Times are mission seconds except `wall_s`; what is not known, or not yet, is null or empty."""

    model_config = ConfigDict(json_schema_extra={"required": ["roster", *WRITTEN_FROM_THE_START]})

    roster: list[int] = []
    scenario: Scenario | None = None
    seed: int | None = None
    backend: BackendName | None = None
    versions: dict[str, str] = {}
    started_at: str | None = None
    wall_s: float | None = None
    settled: bool = False
    vehicles: dict[AgentKey, dict[str, Any]] = {}
    unmatched_fates: list[str] = []
    """A sentence for each scripted fate that decided nothing, each injection that sent nothing, and each vehicle that
    does not simulate what was to befall it."""
    capture: dict[AgentKey, CapturedFrames] | None = None
    """Of each vehicle, if captures were asked for and came to their end."""
    ground_station: GroundStationRecord | None = None
    """If the run had one."""
    characteristics: dict[str, CharacteristicRecord] = {}
    steps: JudgementRecord | None = None
    """Whether every agent did at every step what the algorithms say."""
    records: JudgementRecord | None = None
    """Whether what two records tell about the same thing agrees."""
    liveness: JudgementRecord | None = None
    """Whether the swarm became idle once no more events came."""
    figures: dict[str, float | int | None] = {}
    survival: Survival | None = None
    rogue: list[RogueInjection] = []
    """What the rogue node sent and the agents did with it, for each injection of the timeline, in order."""
    errors: list[str] = []
    """A sentence for each file that the checker could not use, or not wholly."""

    @model_validator(mode="after")
    def _staggered_as_the_scenario_says(self) -> "RunRecord":
        if self.scenario is not None:
            self.stagger = self.scenario.stagger
        return self

    @property
    def known_agents(self) -> list[int]:
        """All agents that it names anywhere, whether or not they left anything; the lowest ID first."""
        asked = self.scenario.roster if self.scenario else ()
        return sorted({*self.roster, *asked, *map(int, self.agents), *map(int, self.vehicles)})

    @property
    def judgements(self) -> dict[str, CharacteristicRecord | JudgementRecord]:
        """The verdicts on the characteristics by number, and those beside them by key."""
        beside = {key: judgement for key in BESIDE if (judgement := getattr(self, key)) is not None}
        return {**self.characteristics, **beside}

    def to_json(self) -> dict[str, Any]:
        """The document, every key of it."""
        return self.model_dump(mode="json", by_alias=True)
