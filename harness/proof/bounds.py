"""The bounds of a proof: the number of agents and blocks, the network, and the faults."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from harness.errors import HarnessError
from harness.play.core_version import edited_files
from harness.play.variant import variant_in_use
from harness.present.text import did_you_mean
from harness.scenario.agent_options import Stagger, Staggered, staggered
from ucp.quirks import check_quirk
from ucp.settings import MAX_TIMER_S, Settings
from ucp.short_value import shown

Network = Literal["lossless", "lossy", "any"]
FAULTS = ("reboot", "death", "duplicate")
MAX_AGENTS = 9
MAX_BLOCKS = 9
MAX_LIES = 9
MAX_COINCIDENCES = 9
MAX_LOSSES = 9
EVENT_FILLS_BLOCK = {"max_block_bytes": 267}
"""Settings with which a single event completes a block."""


class BoundsError(HarnessError):
    """An error: the bounds of a proof are impossible."""


@dataclass(frozen=True)
class Bounds:
    """The bounds of a proof: `agents` agents (1 to 9) complete `blocks` blocks in all (1 to 9).

    - `network`: one of three values. With `lossless`, no message is lost. With `lossy`, any agent may lose any message.
      With `any`, messages may also be late, repeated and out of order.
    - `faults`: any of `reboot`, `death` and `duplicate`. A reboot and a death happen at most once in a run.
    - `timers_any`: timers may expire in any order, regardless of their durations.
    - `coincidences`: the maximum number of coincidences. In a coincidence, two independent events happen at the same
      moment by chance. None means any number.
    - `settings`: protocol settings of all agents, by name.
    - `quirks`: deliberate mistakes of all agents, by name (see `ucp.quirks`).
    - `reduced`: treat states that behave alike as one state. `prove` does so only if `why_not_reduced` gives no reason.
    - `steps`: compare each step of the agents with the step of the reference implementation.
    - `stagger`: for each timer, the seconds by which it is longer than the same timer of the agent with the next lower
      ID.
    - `captured`: the ID of an agent whose keys an attacker has. From an arbitrary moment on, the attacker sends in the
      name of this agent.
    - `lies`: the maximum number of messages that the attacker sends, unless the network is `any`. Each message can
      reach any agents.
    - `clocks_any`: at each comparison of two blocks, either of them may be the older one.
    - `losses`: the maximum number of lost messages, without messages that would have had no effect. None means any
      number.
    - `zones_contained`: a state also represents other states. These states have the same local states, but only some of
      the possible timer values.
    - `crossing`: messages of several agents may cross. If false, all consequences of an action end before the next
      action.

    Raises BoundsError for values or combinations that are impossible.
    """

    agents: int = 2
    blocks: int = 2
    network: Network = "lossy"
    faults: tuple[str, ...] = ()
    timers_any: bool = False
    coincidences: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    quirks: Mapping[str, bool | float] = field(default_factory=dict)
    reduced: bool = True
    steps: bool = False
    stagger: Stagger = field(default_factory=dict)
    captured: int | None = None
    lies: int = 1
    clocks_any: bool = False
    losses: int | None = None
    crossing: bool = True
    zones_contained: bool = False

    def __post_init__(self) -> None:
        for name, count, most in (("agents", self.agents, MAX_AGENTS), ("blocks", self.blocks, MAX_BLOCKS)):
            if not 1 <= count <= most:
                raise BoundsError(f"--{name} must be 1..{most}, not {count}")
        if self.network not in get_args(Network):
            raise BoundsError(f"--network must be one of {', '.join(get_args(Network))}, not {self.network!r}")
        for fault in self.faults:
            if fault not in FAULTS:
                raise BoundsError(f"--faults must be some of {', '.join(FAULTS)}, not {fault!r}")
        self._check_captured()
        self._check_time()
        if self.losses is not None and not 0 <= self.losses <= MAX_LOSSES:
            raise BoundsError(f"--losses must be 0..{MAX_LOSSES}, not {self.losses}")
        if self.losses is not None and self.network != "lossy":
            raise BoundsError("--losses needs --network lossy: leave out --losses")
        if not self.crossing and self.network == "any":
            raise BoundsError(
                "--no-crossing does not apply to --network any, where messages take any time: leave out --no-crossing"
            )
        if self.stagger and self.network == "any":
            raise BoundsError(
                "--stagger does not apply to --network any, which explores each agent alone: leave out --stagger"
            )
        for name, step_s in self.stagger.items():
            if name not in get_args(Staggered) or type(step_s) not in (int, float) or not 0 <= step_s <= MAX_TIMER_S:
                known = ", ".join(get_args(Staggered))
                raise BoundsError(f"--stagger must be seconds for one of {known}, not {name}={shown(step_s)}")
        names = [field.name for field in dataclasses.fields(Settings)]
        for name in self.settings:
            if name not in names:
                known = f"{', '.join(names)}{did_you_mean(name, names)}"
                raise BoundsError(f"--settings {name} is unknown: use one of {known}")
        if self.settings.get("answer_spread_s"):
            raise BoundsError(
                "--settings answer_spread_s has no meaning here, because messages arrive at any time: leave it out"
            )
        try:
            self.agent_settings(self.agents)
            for name, value in self.quirks.items():
                check_quirk(name, value)
        except (TypeError, ValueError) as error:
            raise BoundsError(f"{error}") from None

    def _check_captured(self) -> None:
        if self.captured is None:
            return
        if not (self.agents > 1 and 1 <= self.captured <= self.agents):
            raise BoundsError(f"--captured must be one of 2 or more agents, not {self.captured} of {self.agents}")
        if not 0 <= self.lies <= MAX_LIES:
            raise BoundsError(f"--lies must be 0..{MAX_LIES}, not {self.lies}")
        if self.quirks or "death" in self.faults:
            raise BoundsError("--captured excludes --quirk and the fault death: leave them out")

    def _check_time(self) -> None:
        if self.coincidences is not None and not 0 <= self.coincidences <= MAX_COINCIDENCES:
            raise BoundsError(f"--coincidences must be 0..{MAX_COINCIDENCES}, not {self.coincidences}")
        for option, given in (
            ("--coincidences", self.coincidences is not None),
            ("--clocks any", self.clocks_any),
            ("--zones contained", self.zones_contained),
        ):
            if given and (self.timers_any or self.network == "any"):
                raise BoundsError(f"{option} does not apply to --timers any and --network any: leave it out")
        if self.clocks_any and (self.quirks or self.captured is not None):
            raise BoundsError("--clocks any excludes --quirk and --captured: leave them out")

    def why_not_reduced(self) -> str | None:
        """Return the reason why the prover must not merge states that behave alike. Return None if the prover may merge
        such states.
        """
        if edited := edited_files():
            return f"it assumes the released core, and {', '.join(edited)} was edited"
        if (variant := variant_in_use()) is not None:
            return f"it assumes the released core, and the variant is {variant.in_words}"
        if wrong := [name for name, value in self.quirks.items() if value]:
            return f"it assumes the released core, and the agents have the quirk {' and '.join(wrong)}"
        return None

    @property
    def nameless(self) -> bool:
        """True if states are stored without the IDs of agents, so that agents with equal states are equal. Each agent
        then uses the ID 1 for itself.

        False if an agent is captured or the network is `any`, because messages then depend on the sender's ID.
        """
        return self.reduced and self.captured is None and self.network != "any"

    @property
    def alike(self) -> bool:
        """True if two states that differ only by an exchange of agents count as one state."""
        return self.nameless and not self.stagger

    @property
    def blocks_alike(self) -> bool:
        """True if two states that differ only by an exchange of blocks count as one state."""
        return self.nameless and self.clocks_any

    @property
    def settles(self) -> bool:
        """True if each answer arrives or is lost at the moment at which the query is sent, so that no state has
        messages in transit.
        """
        return self.reduced and self.captured is None

    def agent_settings(self, agent_id: int = 1) -> Settings:
        return staggered(Settings(**{**EVENT_FILLS_BLOCK, **self.settings}), self.stagger, agent_id - 1)

    def in_words(self) -> str:
        parts = [
            f"{self.agents} agent{'s' if self.agents > 1 else ''}",
            f"{self.blocks} block{'s' if self.blocks > 1 else ''}",
            f"network {self.network}",
        ]
        if self.captured is not None:
            lies = "any number of lies" if self.network == "any" else f"{self.lies} lie{'s' * (self.lies != 1)}"
            parts.append(f"agent {self.captured} captured, {lies}")
        parts += [f"faults {', '.join(self.faults)}"] if self.faults else []
        parts += [] if self.crossing else ["nothing crosses"]
        parts += ["timers in any order"] if self.timers_any else []
        if self.coincidences is not None:
            parts += [f"{self.coincidences or 'no'} coincidence{'s' * (self.coincidences != 1)}"]
        parts += ["any block the older"] if self.clocks_any else []
        parts += ["contained zones left out"] if self.zones_contained else []
        if self.losses is not None:
            parts += [f"{self.losses or 'no'} loss{'es' * (self.losses != 1)}"]
        parts += [f"{name} {value}" for name, value in self.settings.items()]
        parts += [f"stagger {name} {step_s}" for name, step_s in self.stagger.items()]
        parts += [f"quirk {name}" for name in self.quirks]
        return ", ".join(parts)
