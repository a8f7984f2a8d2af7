"""Explore the same bounds twice: with the real agent, and with TLC and the TLA+ specification."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from math import gcd

from harness.errors import INCOMPLETE, INTERRUPTED, VIOLATED
from harness.proof._progress_bar import Ended, ExplorationProgress
from harness.proof._proof import Limits
from harness.proof.bounds import Bounds, BoundsError
from harness.proof.graph._exploration import explore
from harness.proof.model._global_states import ModelSwarm
from harness.proof.questions import _convergence
from harness.proof.specification import _spec_states as states
from harness.proof.specification._spec_states import TIMERS, readings, unspecified
from harness.proof.specification._tlc import checked, command, in_tla
from ucp.clock import MICROSECONDS

MEGABYTE = 1e6
AS_PRINTED = {"change_without_new_vote": 5, "stop_after_stack": 16}
"""The two deliberate mistakes (quirks) that the specification also supports. With these quirks, an agent follows the
printed algorithms of the thesis at two places where they contradict the text of the thesis.
"""
INVARIANTS = {"Characteristic2": "2", "Characteristic3": "3", "Characteristic4": "4", "NobodyHangs": "hang"}
"""Name of an invariant in the specification -> key of the violation that `prove` reports."""


@dataclass(frozen=True)
class SecondOpinion:
    """The results of both explorations: with the real agent, and with TLC.

    States that differ only in remaining timer durations count as one state.
    """

    bounds: Bounds
    ended: Ended
    flaw: str | None
    violated: str | None
    states: int | None = None
    """Number of states that the real agent reaches. None if this exploration is incomplete."""
    specified: int | None = None
    """Number of states of the specification. It is at most the number of states that TLC counts. None if the
    exploration with TLC is incomplete.
    """
    distinct: int | None = None
    """Number of states that TLC counts."""
    only_real: int | None = None
    """Number of states that only the exploration with the real agent found."""
    only_specified: int | None = None
    """Number of states that only the exploration with TLC found."""
    livelock: bool | None = None
    specified_livelock: bool | None = None
    """True if the specification has an endless cycle without losses. None if the network loses messages."""

    @property
    def decided(self) -> bool:
        return self.ended in ("complete", "flaw")

    @property
    def agrees(self) -> bool:
        """True if no limit ended an exploration early, and both explorations agree on the violation, the states, and
        endless cycles.
        """
        same = not self.only_real and not self.only_specified and self.livelock == self.specified_livelock
        return self.decided and self.flaw == self.violated and same

    @property
    def exit_status(self) -> int:
        if not self.decided:
            return INTERRUPTED if self.ended == "interrupted" else INCOMPLETE
        return 0 if self.agrees and self.flaw is None and not self.livelock else VIOLATED

    def to_json(self) -> dict[str, object]:
        bounds = asdict(self.bounds)
        return {
            "schema": "ucp-second-opinion/1",
            "agents": bounds["agents"],
            "blocks": bounds["blocks"],
            "network": bounds["network"],
            "crossing": bounds["crossing"],
            "timers": "any" if bounds["timers_any"] else "duration",
            "stagger": bounds["stagger"],
            "settings": dict(self.bounds.settings),
            "quirks": dict(self.bounds.quirks),
            "ended": self.ended,
            "agree": self.agrees,
            "prove": {
                "states": self.states,
                "flaw": self.flaw,
                "only_here": self.only_real,
                "livelock": self.livelock,
            },
            "tlc": {
                "states": self.specified,
                "distinct": self.distinct,
                "violated": self.violated,
                "only_here": self.only_specified,
                "livelock": self.specified_livelock,
            },
        }

    def in_words(self) -> Iterator[str]:
        yield f"{self.bounds.in_words()}: the agent, and the specification in TLA+"
        if not self.decided:
            yield f"- not decided: the search is incomplete ({self.ended})"
            return
        if self.flaw is None and self.violated is None:
            yield "✔ both hold: characteristics 2, 3 and 4, and no agent hangs"
            yield f"  states: {self.states:,} of the agent, {self.specified:,} of the specification"
            if not self.only_real and not self.only_specified:
                yield "✔ they are the same states"
            else:
                yield (
                    f"✘ {self.only_real:,} states exist only for the agent, {self.only_specified:,} only in the "
                    "specification"
                )
            if self.livelock != self.specified_livelock:
                yield f"✘ only the {'agent' if self.livelock else 'specification'} has a cycle that lasts for ever"
            elif self.livelock is not None:
                yield (
                    "✘ both have a cycle that lasts for ever"
                    if self.livelock
                    else "✔ neither has a cycle that lasts for ever"
                )
            return
        yield f"{'✔ both violate' if self.agrees else '✘ they differ'}: the agent {_word(self.flaw)}, the " + (
            f"specification {_word(self.violated)}"
        )


def _word(kind: str | None) -> str:
    return "nothing" if kind is None else f"characteristic {kind}" if kind.isdecimal() else kind


def second_opinion(
    bounds: Bounds,
    limits: Limits | None = None,
    *,
    watch: Callable[[ExplorationProgress], None] = lambda progress: None,
) -> SecondOpinion:
    """Explore the bounds with the real agent and with TLC, and return the results. Raises BoundsError for bounds that
    the specification does not support, and NoCheckerError without TLC.
    """
    bounds, limits = replace(bounds, reduced=False), limits or Limits()
    config = _config(bounds)
    command()
    graph = explore(ModelSwarm(bounds), most_bytes=limits.most_bytes, most_s=limits.most_s, watch=watch)
    flaw = None if graph.flaw is None else graph.flaw.kind
    if graph.ended not in ("complete", "flaw"):
        return SecondOpinion(bounds, graph.ended, flaw, None)
    most_s = None if limits.most_s == float("inf") else limits.most_s
    memory_mb = int(limits.most_bytes / MEGABYTE)
    try:
        with checked("Swarm", config, dump=True, memory_mb=memory_mb, most_s=most_s) as said:
            violated = said.violated and INVARIANTS[said.violated]
            if flaw or violated:
                return SecondOpinion(bounds, "flaw", flaw, violated)
            lossless = bounds.network == "lossless"
            real, specified = set(states.real(graph)), set(states.specified(said.states))
            return SecondOpinion(
                bounds,
                "complete",
                None,
                None,
                len(real),
                len(specified),
                said.distinct,
                len(real - specified),
                len(specified - real),
                bool(_convergence.look(graph).cycles) if lossless else None,
                states.goes_round(said.states) if lossless else None,
            )
    except TimeoutError:
        return SecondOpinion(bounds, "time", flaw, None)


def _config(bounds: Bounds) -> str:
    """Return the TLC configuration for these bounds. Raises BoundsError if the specification does not support them."""
    if bounds.network == "any":
        raise BoundsError("the specification covers --network lossless and lossy only: choose one of them")
    if bounds.faults:
        raise BoundsError("the specification has no faults: leave out --faults")
    if bounds.coincidences is not None:
        raise BoundsError("the specification does not count coincidences: leave --coincidences out")
    if bounds.losses is not None:
        raise BoundsError("the specification does not count losses: leave --losses out")
    if bounds.clocks_any:
        raise BoundsError("the specification has synchronised clocks: leave out --clocks any")
    if bounds.captured is not None:
        raise BoundsError("the specification has no attackers: leave out --captured")
    unknown = [name for name in bounds.quirks if name not in AS_PRINTED]
    if unknown:
        raise BoundsError(f"the specification has only the quirks {' and '.join(AS_PRINTED)}: leave out {unknown[0]}")
    settings = bounds.agent_settings()
    if (name := unspecified(settings)) is not None:
        raise BoundsError(f"the specification does not have the setting {name}: leave out --settings {name}=...")
    durations = {
        name: round(duration_s * MICROSECONDS)
        for timer, names in TIMERS.items()
        for name, duration_s in zip(names, (getattr(settings, timer), bounds.stagger.get(timer, 0.0)), strict=True)
    }
    unit = gcd(*durations.values())
    constants = {
        "Agents": bounds.agents,
        "MostBlocks": bounds.blocks,
        "Lossy": bounds.network == "lossy",
        "Crossing": bounds.crossing,
        "Timed": not bounds.timers_any,
        **{name: duration // unit for name, duration in durations.items()},
        **readings(settings),
        "AsPrinted": f"{{{', '.join(str(AS_PRINTED[name]) for name, value in bounds.quirks.items() if value)}}}",
    }
    assigned = (f"  {name} = {in_tla(value)}" for name, value in constants.items())
    return "\n".join(["SPECIFICATION Spec", "CONSTANTS", *assigned, "INVARIANTS", *INVARIANTS, ""])
