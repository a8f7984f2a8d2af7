"""What a scenario changes while it runs: the network, who is alive, and what a rogue node sends."""

from typing import TYPE_CHECKING, Any, Literal, get_type_hints

from pydantic import create_model, model_validator

from harness.scenario.faults import ASKED_FOR, Agents, Fault
from harness.scenario.injection import (
    INJECTIONS,
    Corrupt,
    Delay,
    Duplicate,
    Flood,
    Forge,
    Injection,
    InjectionName,
    Replay,
)
from harness.scenario.model import Instant, Model, VehicleId
from harness.scenario.network import Loss


class _Entry(Model):
    """At `at_s` mission seconds, one change: a new loss, a partition, heal; something happens to agents; an injection.

    What happens to agents, from `crash` to `resume`: `harness.scenario.faults`. Injections, from `replay` to `flood`:
    `harness.scenario.injection`.
    """

    at_s: Instant
    loss: Loss | None = None
    partition: list[list[VehicleId]] | None = None
    heal: Literal[True] | None = None
    replay: Replay | None = None
    duplicate: Duplicate | None = None
    delay: Delay | None = None
    corrupt: Corrupt | None = None
    forge: Forge | None = None
    flood: Flood | None = None

    @property
    def injection(self) -> tuple[InjectionName, Injection] | None:
        """What a rogue node sends, if it does."""
        return next(((name, found) for name in INJECTIONS if (found := getattr(self, name)) is not None), None)

    @property
    def fault(self) -> Fault | None:
        """What happens to agents, if anything does."""
        for kind in ASKED_FOR:
            if (agents := getattr(self, kind.what)) is not None:
                return kind(self.at_s, tuple(agents), **{key: getattr(self, key) for key in kind.further_keys()})
        return None

    @property
    def ends_at_s(self) -> float:
        """When the last thing that it says happens."""
        if self.fault is not None:
            return self.fault.course()[-1].at_s
        return self.at_s + (self.injection[1].lasts_s if self.injection else 0.0)

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        changes = ("loss", "partition", "heal", *(kind.what for kind in ASKED_FOR), *INJECTIONS)
        if sum(getattr(self, change) is not None for change in changes) != 1:
            named = (f"`{change}{': true' if change == 'heal' else ''}`" for change in changes)
            raise ValueError(f"needs exactly one of {', '.join(named)}")
        for kind in ASKED_FOR:
            given = [key for key in kind.further_keys() if getattr(self, key) is not None]
            if given and getattr(self, kind.what) is None:
                raise ValueError(f"{' and '.join(f'`{key}`' for key in kind.further_keys())} belong to `{kind.what}`")
            if len(given) < len(kind.further_keys()) and getattr(self, kind.what) is not None:
                raise ValueError(f"a {kind.what} needs {kind.keys_in_words}")
        return self


def _keys_of_faults() -> dict[str, Any]:
    """The fields of an entry that faults bring along: the agents, by the fault's name, and its further keys."""
    annotations: dict[str, Any] = {}
    for kind in ASKED_FOR:
        said = get_type_hints(kind, include_extras=True)
        annotations |= {kind.what: Agents, **{key: said[key] for key in kind.further_keys()}}
    return {key: (annotation | None, None) for key, annotation in annotations.items()}


if TYPE_CHECKING:
    TimelineEntry = _Entry
else:
    TimelineEntry = create_model("TimelineEntry", __base__=_Entry, __doc__=_Entry.__doc__, **_keys_of_faults())
