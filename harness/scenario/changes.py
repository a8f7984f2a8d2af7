"""Represent the timeline of a run as objects: network changes, faults and injections.

The timeline is computed before the run, and only from the scenario. Every backend therefore plays the same timeline.
The checker does not use this timeline.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

from harness.scenario import Scenario
from harness.scenario.faults import Fault
from harness.scenario.faults.fault import planned_key
from harness.scenario.injection import Injection, InjectionName
from netem.conditions import Delay, GilbertElliott, LinkConditions, NetworkConditions

RANGE = "range"
"""Name of a network change that the scenario does not contain. It occurs because flying vehicles change their
distances.
"""
FINAL_RECONCILE = "final reconcile"
"""Name of the network change before the final reconcile."""
NO_MORE_FATES = "no more fates"
"""Name of the record that marks the end of the scripted fates. Nothing changes at this time."""


@dataclass(frozen=True)
class NetworkChange:
    """A change of the network at mission second `at_s`, with a name (`what`), a description (`detail`) and the new
    conditions.
    """

    at_s: float
    what: str
    detail: str
    conditions: NetworkConditions
    clears_all: bool = False
    """True if the change also ends the loss that depends on distance."""
    losses: Mapping[str, float] = field(default_factory=dict)
    """Radio losses that have changed: pair of vehicles, as in "1-2" -> probability, 0 to 1."""
    by_hand: bool = False
    """True if a user requested the change during the run."""
    channel: str | None = None
    """Preset of the radio channel that vehicles share. On a shared channel, any message may be lost."""

    def to_json(self, at_s: float) -> dict[str, object]:
        """Return the record of this change. `at_s` is the mission second at which the change was really made."""
        return {
            "at_s": at_s,
            "what": self.what,
            "detail": self.detail,
            "fully_connected": self.conditions.fully_connected and self.channel is None,
            **({"losses": dict(self.losses)} if self.losses else {}),
            **({} if self.what in (RANGE, FINAL_RECONCILE) else planned_key(self.at_s, at_s)),
            **_by_hand_entry(self.by_hand),
        }


@dataclass(frozen=True)
class TimedInjection:
    """An injection of messages that starts at mission second `at_s`. Injections are numbered from 1 in order of
    time.
    """

    at_s: float
    what: InjectionName
    injection: Injection
    number: int
    by_hand: bool = False

    @property
    def detail(self) -> str:
        return self.injection.in_words()

    def to_json(self, at_s: float) -> dict[str, object]:
        """Return the record of this injection. `at_s` is the mission second at which the injection really started."""
        record = {"at_s": at_s, "what": self.what, "detail": self.detail}
        return {**record, **planned_key(self.at_s, at_s), **_by_hand_entry(self.by_hand)}


def _by_hand_entry(by_hand: bool) -> dict[str, object]:
    return {"by_hand": True} if by_hand else {}


Change = NetworkChange | Fault | TimedInjection


def timeline_of(scenario: Scenario) -> list[Change]:
    """Return all changes of the scenario in order of time. The first change sets the initial state of the network."""
    first, *states = _network_states(scenario)
    return [
        first,
        *sorted([*states, *scenario.faults_in_order(), *injections_of(scenario)], key=lambda change: change.at_s),
    ]


def injections_of(scenario: Scenario) -> list[TimedInjection]:
    """Return the injections of the scenario in order of time."""
    entries = [(entry.at_s, *entry.injection) for entry in scenario.timeline_in_order() if entry.injection]
    return [TimedInjection(at_s, what, injection, number) for number, (at_s, what, injection) in enumerate(entries, 1)]


def silent_injections(begun: Sequence[TimedInjection], sent: Mapping[int, int]) -> list[str]:
    """Return a sentence for each injection that sent nothing. `sent` maps the number of an injection to the number of
    its datagrams.
    """
    return [
        f"{injected.what} at {injected.at_s:g} s ({injected.detail}) sent nothing, for nothing like it was heard"
        for injected in begun
        if sent.get(injected.number) == 0
    ]


def _network_states(scenario: Scenario) -> list[Change]:
    """Return all changes of the network in order of time. Changes at the same time are combined into one."""
    changes = [_change(step.at_s, step.what, step.network.conditions()) for step in scenario.network_steps()]
    if (channel := scenario.network.channel) is None:
        return [*changes]
    detail = f"shared channel {channel.preset}"
    return [replace(change, detail=f"{change.detail}, {detail}", channel=channel.preset) for change in changes]


def final_reconcile(at_s: float) -> NetworkChange:
    """Return the network change for the final reconcile. The change removes all network conditions, so that all
    messages arrive.
    """
    return replace(_change(at_s, FINAL_RECONCILE, NetworkConditions()), clears_all=True)


def _change(at_s: float, what: str, conditions: NetworkConditions) -> NetworkChange:
    return NetworkChange(at_s, what, describe(conditions), conditions)


MAX_DESCRIBED_LINKS = 8


def describe(conditions: NetworkConditions) -> str:
    """Return network conditions as text, such as "loss 15 %, loss 50 % to 3, loss 90 % from 1 to 2, partition 1 2 | 3 4
    5".

    The text contains the differences between each receiver and the default, and between each link and its receiver.
    """
    words = _differences(conditions.default, LinkConditions())
    if conditions.default.loss == 0.0:
        words.insert(0, "loss 0 %")
    for receiver, link in conditions.receivers.items():
        words += [f"{word} to {receiver}" for word in _differences(link, conditions.default)]
    linked = []
    for sender, links in groupby(conditions.links.items(), key=lambda item: item[0][0]):
        receivers: dict[str, list[str]] = {}
        for (_, receiver), link in links:
            for word in _differences(link, conditions.receivers.get(receiver, conditions.default)):
                receivers.setdefault(word, []).append(str(receiver))
        linked += [f"{word} from {sender} to {' '.join(named)}" for word, named in receivers.items()]
    words += linked[:MAX_DESCRIBED_LINKS]
    if len(linked) > MAX_DESCRIBED_LINKS:
        words.append(f"{len(linked) - MAX_DESCRIBED_LINKS} more differences of links")
    if conditions.partition:
        words.append("partition " + " | ".join(" ".join(map(str, sorted(group))) for group in conditions.partition))
    return ", ".join(words)


def _differences(link: LinkConditions, usual: LinkConditions) -> list[str]:
    words = []
    if link.loss != usual.loss:
        words.append(_loss(link.loss))
    if link.delay != usual.delay:
        words.append(_delay(link.delay))
    if link.duplicate != usual.duplicate:
        words.append(f"duplicate {_percent(link.duplicate)}")
    if link.reorder != usual.reorder:
        words.append(f"reorder {_percent(link.reorder)}")
    if link.corrupt != usual.corrupt:
        words.append(f"corrupt {_percent(link.corrupt)}")
    if link.rate != usual.rate:
        words.append("no rate" if link.rate is None else f"rate {_rate(link.rate)}")
    if link.limit != usual.limit:
        words.append("no limit" if link.limit is None else f"limit {link.limit} packets")
    return words


def _loss(loss: float | GilbertElliott) -> str:
    if not isinstance(loss, GilbertElliott):
        return f"loss {_percent(loss)}"
    bursts = [f"{_percent(loss.p)} in", f"{_percent(loss.r)} out"]
    if (loss.loss_bad, loss.loss_good) != (1.0, 0.0):
        bursts += [f"{_percent(loss.loss_bad)} inside", f"{_percent(loss.loss_good)} outside"]
    return f"loss in bursts ({', '.join(bursts)})"


def _delay(delay: Delay | None) -> str:
    if delay is None:
        return "no delay"
    if not delay.jitter_s:
        return f"delay {_duration(delay.mean_s)}"
    shape = "" if delay.distribution == "uniform" else f" {delay.distribution}"
    return f"delay {_duration(delay.mean_s)} ± {_duration(delay.jitter_s)}{shape}"


def _duration(seconds: float) -> str:
    return f"{seconds:g} s" if seconds >= 1 else f"{seconds * 1000:g} ms"


def _rate(bits_per_second: float) -> str:
    for unit, size in (("Gbit/s", 1e9), ("Mbit/s", 1e6), ("kbit/s", 1e3)):
        if bits_per_second >= size:
            return f"{bits_per_second / size:g} {unit}"
    return f"{bits_per_second:g} bit/s"


def _percent(probability: float) -> str:
    return f"{probability * 100:g} %"
