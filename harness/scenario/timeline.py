"""What a scenario changes while it runs: the network, who is alive, and what a rogue node sends."""

from typing import TYPE_CHECKING, Any, Literal, get_type_hints

from pydantic import ValidationInfo, create_model, field_validator, model_validator

from harness.scenario._network import Disturbance
from harness.scenario.faults import ASKED_FOR, Agents, Fault
from harness.scenario.injection import (
    INJECTIONS,
    Corrupt,
    DelayedCopy,
    Duplicate,
    Flood,
    Forge,
    Injection,
    InjectionName,
    Lie,
    Replay,
)
from harness.scenario.strict_model import Instant, Seconds

NETWORK_KEYS = ("loss", "partition", "heal", "network")
"""Keys of an entry that change the network."""


class _Entry(Disturbance):
    """At `at_s` mission seconds, one change: of the network; something happens to agents; an injection.

    `loss`, and all keys of `network`, change what they name and leave the rest of the network as it is; `partition`
    stands until `heal` or another one. With `for_s` such a change passes: after so many mission seconds what it has
    changed is as it would be without it.

    What happens to agents, from `crash` to `resume`: `harness.scenario.faults`. Injections, from `replay` to `lie`:
    `harness.scenario.injection`.
    """

    at_s: Instant
    for_s: Seconds | None = None
    heal: Literal[True] | None = None
    replay: Replay | None = None
    duplicate: Duplicate | None = None
    delay: DelayedCopy | None = None
    corrupt: Corrupt | None = None
    forge: Forge | None = None
    flood: Flood | None = None
    lie: Lie | None = None

    @field_validator("delay", "duplicate", "corrupt", mode="before")
    @classmethod
    def _an_injection(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, int | float):
            of_the_network = f"`network: {{{info.field_name}: {value}}}`"
            raise ValueError(f"it is what a rogue node does; {of_the_network} is the network's")
        return value

    @property
    def injection(self) -> tuple[InjectionName, Injection] | None:
        """What a rogue node sends, if it does."""
        return next(((name, injection) for name in INJECTIONS if (injection := getattr(self, name)) is not None), None)

    @property
    def fault(self) -> Fault | None:
        """What happens to agents, if anything does."""
        for kind in ASKED_FOR:
            if (agents := getattr(self, kind.what)) is not None:
                return kind(self.at_s, tuple(agents), **{key: getattr(self, key) for key in kind.further_keys()})
        return None

    @property
    def disturbs(self) -> str | None:
        """The key by which it changes the network, if it does."""
        return next((key for key in NETWORK_KEYS if getattr(self, key) is not None), None)

    @property
    def ends_at_s(self) -> float:
        """When the last thing that it says happens."""
        if (fault := self.fault) is not None:
            return fault.course()[-1].at_s
        lasts_s = self.injection[1].lasts_s if self.injection else self.for_s or 0.0
        return round(self.at_s + lasts_s, 6)

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        changes = (*NETWORK_KEYS, *(kind.what for kind in ASKED_FOR), *INJECTIONS)
        if sum(getattr(self, change) is not None for change in changes) != 1:
            named = (f"`{change}{': true' if change == 'heal' else ''}`" for change in changes)
            raise ValueError(f"needs exactly one of {', '.join(named)}")
        if self.for_s is not None and (self.heal or not self.disturbs):
            raise ValueError("`for_s` belongs to `loss`, `partition` and `network`")
        for kind in ASKED_FOR:
            keys, is_meant = kind.further_keys(), getattr(self, kind.what) is not None
            given = [key for key in keys if getattr(self, key) is not None]
            if given and not is_meant:
                named = (f"`{key}`" for key in keys)
                raise ValueError(f"{' and '.join(named)} belong{'s' if len(keys) == 1 else ''} to `{kind.what}`")
            if is_meant and len(given) < len(keys):
                raise ValueError(f"a {kind.what} needs {kind.keys_in_words}")
        return self


def _keys_of_faults() -> dict[str, Any]:
    """The fields of an entry that faults bring along: the agents, by the fault's name, and its further keys."""
    annotations: dict[str, Any] = {}
    for kind in ASKED_FOR:
        hints = get_type_hints(kind, include_extras=True)
        annotations |= {kind.what: Agents, **{key: hints[key] for key in kind.further_keys()}}
    return {key: (annotation | None, None) for key, annotation in annotations.items()}


if TYPE_CHECKING:  # a type checker does not run the code that makes the class
    TimelineEntry = _Entry
else:
    TimelineEntry = create_model("TimelineEntry", __base__=_Entry, __doc__=_Entry.__doc__, **_keys_of_faults())
