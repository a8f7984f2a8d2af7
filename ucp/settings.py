"""The settings of an agent. They are durations of timers, sizes, interpretations of ambiguous passages in the thesis,
and changes of the protocol.

Each setting is declared once, as a field of `Settings`. The declaration has its allowed values and its effect. Other
parts of the project read the declarations and do not contain the names of settings. These parts are the features, the
schemas, the table in contract/CONTRACT.md, the variants of the conformance test, the changes that `explore` tries, and
the constants of the TLA+ specification. A new setting therefore needs only a field here and a change of the handler
that uses it. The declaration is part of the field's type (`Annotated`). Field options of `dataclasses` would need an
import that delays the start of an agent.
"""

import math
from typing import Annotated, Any, Literal, get_args

from ucp._dataclass import dataclass
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import MAX_EVENT_BYTES
from ucp.short_value import shown

MAX_TIMER_S = 1e9
"""Maximum duration of a timer: 30 years."""


@dataclass(eq=False, frozen=True, slots=True)
class NumberSetting:
    """The declaration of a setting whose value is a number."""

    sentence: str
    """The effect of the setting, as the table in contract/CONTRACT.md states it."""
    allowed: str
    """The allowed range of the setting as text."""
    low: float
    high: float
    whole: bool = False
    is_feature: bool = False
    """True if each value other than the default is a feature that the agent must support. The feature has the name of
    the setting. Missions and traces omit the default.
    """


@dataclass(eq=False, frozen=True, slots=True)
class ChoiceSetting:
    """The declaration of a setting with a few possible values. An agent needs a feature for each value except the
    default.
    """

    sentence: str
    """The effect of the setting, as the table in contract/CONTRACT.md states it. For a boolean setting, the effect of
    true.
    """
    values: tuple[bool, ...] | tuple[str, ...] = (False, True)
    """The allowed values of the setting. The first one is the default."""
    is_reading: bool = False
    """True if the setting chooses between interpretations of the thesis. `explore` and `reconstruct` try the other
    values.
    """
    always_written: bool = False
    """True if missions and traces contain the setting even with its default. The first agents of contract 2 require
    it.
    """
    constant: str | None = None
    """Name of the constant in the TLA+ specification that is true if the setting does not have its default value. None
    if there is no such constant.
    """

    @property
    def allowed(self) -> str:
        """The allowed values of the setting, as text."""
        return "true or false" if self.values == (False, True) else f"one of {', '.join(map(str, self.values))}"


Phase1Tie = Literal["phase2", "pop"]
Phase2Tie = Literal["oldest", "block"]


def _timer(sentence: str) -> NumberSetting:
    return NumberSetting(sentence, f"more than 0 seconds, at most {MAX_TIMER_S:g}", math.ulp(0.0), MAX_TIMER_S)


def _size(sentence: str, most: str) -> NumberSetting:
    return NumberSetting(sentence, f"1..{most}", 1, MAX_EVENT_DATA_BYTES, whole=True)


def _reading(sentence: str, constant: str, values: tuple[bool, ...] | tuple[str, ...] = (False, True)) -> ChoiceSetting:
    return ChoiceSetting(sentence, values, is_reading=True, always_written=True, constant=constant)


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of an agent, with durations in mission seconds and sizes in bytes. Raises ValueError for impossible
    values.
    """

    vote_timeout_s: Annotated[float, _timer("Duration of the voting timer (Algorithm 2).")] = 10.0
    phase1_timeout_s: Annotated[float, _timer("Duration of the phase 1 timer (Algorithm 8).")] = 5.0
    phase2_timeout_s: Annotated[float, _timer("Duration of the phase 2 timer (Algorithm 12).")] = 5.0
    phase3_timeout_s: Annotated[float, _timer("Duration of the phase 3 timer (Algorithm 16).")] = 5.0
    finalize_gap_s: Annotated[
        float,
        NumberSetting(
            "Pause between the commits of Algorithm 20, so that other agents can follow (Section 4.2). 0 is no pause.",
            f"0..{MAX_TIMER_S:g} seconds",
            0,
            MAX_TIMER_S,
        ),
    ] = 0.1
    max_block_bytes: Annotated[int, _size("Maximum size of the event data in a block.", str(MAX_EVENT_DATA_BYTES))] = (
        MAX_EVENT_DATA_BYTES
    )
    max_event_bytes: Annotated[
        int, _size("Maximum size of an event, including its 11 bytes of header.", "max_block_bytes")
    ] = MAX_EVENT_BYTES
    vote_names_chain: Annotated[
        bool,
        _reading(
            "Algorithms 3 and 4: a vote also names the proposer's chain, so that a late vote of an earlier round does "
            "not count.",
            "VoteNamesChain",
        ),
    ] = False
    changed_before_tally: Annotated[
        bool,
        _reading("Algorithm 5 checks for a changed chain before the tally, instead of after it.", "ChangedBeforeTally"),
    ] = False
    asks_after_commit: Annotated[
        bool,
        ChoiceSetting(
            "Algorithms 5, 7 and 20: an agent that has committed its own block waits for the finalize gap, and then "
            "sends a query. A receiver whose chain has diverged starts a reconcile."
        ),
    ] = False
    top_needs_majority: Annotated[
        bool,
        ChoiceSetting(
            'Algorithm 15: "Is Top Of Chain" ends the search only if more than half of the agents that answered have '
            "this chain. The agent counts itself among them."
        ),
    ] = False
    phase1_tie: Annotated[
        Phase1Tie,
        _reading(
            "Algorithm 11 after a tie: continue with phase 2, as in the thesis, or remove a further block.",
            "Phase1TiePops",
            get_args(Phase1Tie),
        ),
    ] = "phase2"
    phase2_tie: Annotated[
        Phase2Tie,
        _reading(
            'Algorithm 15 after a tie: select the answer with the oldest timestamp. With `block`, "Is Top Of Chain" '
            "never wins a tie.",
            "Phase2TieTakesBlock",
            get_args(Phase2Tie),
        ),
    ] = "oldest"

    answer_spread_s: Annotated[
        float,
        NumberSetting(
            "Maximum delay of an answer (Algorithms 3, 9, 13 and 17). Each answer has its own delay, so that the "
            "answers of many agents do not collide on a shared channel. 0 means no delay.",
            "at least 0 seconds, less than each of the four timers",
            0,
            MAX_TIMER_S,
            is_feature=True,
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        for name, number in NUMBERS.items():
            value = getattr(self, name)
            high = self.max_block_bytes if name == "max_event_bytes" else number.high
            kinds = (int,) if number.whole else (int, float)
            if type(value) not in kinds or not number.low <= value <= high:
                raise ValueError(f"{name} must be {number.allowed}, not {shown(value)}")
        timers = self.vote_timeout_s, self.phase1_timeout_s, self.phase2_timeout_s, self.phase3_timeout_s
        if 0 < self.answer_spread_s >= min(timers):
            allowed = NUMBERS["answer_spread_s"].allowed
            raise ValueError(f"answer_spread_s must be {allowed}, not {shown(self.answer_spread_s)}")
        for name, choice in CHOICES.items():
            value = getattr(self, name)
            if not isinstance(value, type(choice.values[0])) or value not in choice.values:
                raise ValueError(f"{name} must be {choice.allowed}, not {shown(value)}")

    def to_json(self) -> dict[str, Any]:
        """Return the settings as a JSON object for missions and traces. Newer settings (`ADDED`) are omitted if they
        have their default value. An agent that does not know a newer setting can therefore run a mission that does not
        need this setting.
        """
        usual = Settings()
        values = {name: getattr(self, name) for name in self.__match_args__}
        return {name: value for name, value in values.items() if name not in ADDED or value != getattr(usual, name)}


DECLARED: dict[str, NumberSetting | ChoiceSetting] = {
    name: kind.__metadata__[0] for name, kind in Settings.__annotations__.items()
}
"""Name of each setting -> its declaration."""
NUMBERS = {name: declared for name, declared in DECLARED.items() if isinstance(declared, NumberSetting)}
CHOICES = {name: declared for name, declared in DECLARED.items() if isinstance(declared, ChoiceSetting)}
ADDED = (
    *(name for name, choice in CHOICES.items() if not choice.always_written),
    *(name for name, number in NUMBERS.items() if number.is_feature),
)
"""Settings that were added later. The first agents of contract 2 do not know them."""
ALTERNATIVES: dict[str, tuple[str, bool | str]] = {
    name if value is True else f"{name}={value}": (name, value)
    for name, choice in CHOICES.items()
    for value in choice.values[1:]
}
"""Name of a feature -> the setting and the value that need this feature."""
