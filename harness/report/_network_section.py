"""Show the network in the report: its conditions at the start, their changes over time, and all recorded events.

A picture shows partitions, losses, and a tick for each fault over mission time. Horizontal positions are percentages of
the picture's width. The picture therefore fits any screen, and the text in it is never scaled.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.archive.connectivity import Connectivity, LossRates, Pair, quality
from harness.archive.run_record import ChannelRecord, FaultRecord, NetworkState, OperatorCommand, RunRecord
from harness.play.backends import in_virtual_time
from harness.present import text as words
from harness.present.svg import linear_axis
from harness.report._timeline_charts import format_number
from harness.report.map_parts import divisions

_LANE = 24


@dataclass(frozen=True, slots=True)
class ConditionSpan:
    """An interval of mission time in which a network condition did not change."""

    from_s: float
    to_s: float
    text: str
    level: float = 1.0
    """The value of the condition as a number from 0 to 1. The picture fills this share of the row's height."""


def steps(changes: Sequence[tuple[float, str, float]], end_s: float) -> list[ConditionSpan]:
    """Convert changes of a network condition to intervals. A change is a tuple (at_s, text, level), and its level
    applies until the next change. A change to level 0 gives no interval.
    """
    spans: list[ConditionSpan] = []
    in_time = sorted(changes, key=lambda change: change[0])
    for number, (at_s, text, level) in enumerate(in_time):
        until = in_time[number + 1][0] if number + 1 < len(in_time) else end_s
        if level > 0 and 0 <= at_s < min(until, end_s):
            spans.append(ConditionSpan(at_s, min(until, end_s), text, min(level, 1.0)))
    return spans


def draw(lanes: Sequence[tuple[str, list[ConditionSpan]]], ticks: Sequence[tuple[float, str]], end_s: float) -> Markup:
    """Draw the rows of the picture from top to bottom. `ticks` contains a pair (at_s, text) for each fault."""
    parts: list[Markup] = []
    for number, (name, spans) in enumerate(lanes):
        parts.append(
            Markup('<rect class="lane" y="{}" width="100%" height="{}"><title>{}</title></rect>').format(
                number * (_LANE + 4), _LANE, name
            )
        )
        parts += [_span(name, span, number * (_LANE + 4), end_s) for span in spans]
    height = len(lanes) * (_LANE + 4)
    for at_s, text in ticks:
        if 0 <= at_s <= end_s:
            parts.append(
                Markup('<line class="tick" x1="{x}" x2="{x}" y2="{height}"><title>{text}</title></line>').format(
                    x=_share(at_s, end_s), height=height, text=text
                )
            )
    for tick in linear_axis(0.0, end_s, (0.0, 100.0)).ticks:
        anchor = "end" if tick > 0.95 * end_s else "middle" if tick else "start"
        parts.append(
            Markup('<text class="axis" x="{}" y="{}" text-anchor="{}">{}</text>').format(
                _share(tick, end_s), height + 14, anchor, format_number(tick)
            )
        )
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="strip" role="img" width="100%" height="{}"'
        ' aria-label="The network over mission time">{}</svg>'
    ).format(height + 20, Markup("").join(parts))


def _span(lane: str, span: ConditionSpan, y: float, end_s: float) -> Markup:
    """Draw an interval as a nested <svg> element. This element cuts off a text that is too long for the interval."""
    filled = max(2.0, _LANE * span.level)
    return Markup(
        '<svg x="{}" y="{}" width="{}" height="{}"><title>{}</title><rect class="span" y="{:.1f}" width="100%"'
        ' height="{:.1f}"/><text x="6" y="16">{}</text></svg>'
    ).format(
        _share(span.from_s, end_s),
        y,
        _share(span.to_s - span.from_s, end_s),
        _LANE,
        f"{lane}: {span.text}, {words.duration(span.from_s)} to {words.duration(span.to_s)}",
        _LANE - filled,
        filled,
        span.text,
    )


def _share(format_seconds: float, end_s: float) -> str:
    return f"{100 * format_seconds / end_s:.3f}%"


MOST_PAIRS = 10
"""Maximum number of table rows about pairs of vehicles. The table keeps the pairs with the largest losses."""
NAMED_PAIRS = 3
REASONS = {
    "collision": "collision with other frames",
    "half_duplex": "receiver was sending",
    "fade": "fading of the signal",
    "range": "out of range",
    "partition": "on another channel",
    "queue": "full queue",
    "too_long": "message too long for the radio",
}
"""The description of each reason for which a shared radio channel loses a message."""


@dataclass(frozen=True, slots=True)
class NetworkStrip:
    """A picture of the network's conditions over mission time, and the names of its rows from top to bottom."""

    names: list[str]
    picture: Markup


def strip(
    network: Connectivity, faults: Sequence[FaultRecord], end_s: float, channel: ChannelRecord | None = None
) -> NetworkStrip | None:
    """Draw the recorded network conditions up to mission second `end_s`. Return None if no conditions are recorded."""
    if not network.states:
        return None
    partitions = [
        (division.at_s, *(("", 0.0) if division.together else (division.in_words(), 1.0)))
        for division in divisions(network.states)
    ]
    losses = [(losses.at_s, _in_words(losses), losses.mean) for losses in network.losses]
    lanes = [
        ("partition", steps(partitions, end_s)),
        ("loss", steps(losses, end_s)),
        *([("channel load", _load(channel, end_s))] if channel else []),
        *_pairs(network, end_s),
    ]
    ticks = [(fault.at_s, f"{words.duration(fault.at_s)}: {fault.what}") for fault in faults]
    return NetworkStrip([name for name, _ in lanes], draw(lanes, ticks, end_s))


def _load(channel: ChannelRecord, end_s: float) -> list[ConditionSpan]:
    """Return the load of the shared radio channel over time. Neighbouring intervals whose loads round to the same
    percentage are joined.
    """
    loads = [round(share, 2) for share in channel.load] + [0.0]
    changes = [number for number, load in enumerate(loads) if number == 0 or load != loads[number - 1]]
    states = [(number * channel.load_interval_s, words.percent(loads[number]), loads[number]) for number in changes]
    return steps(states, end_s)


def channel(record: RunRecord) -> list[str]:
    """Return sentences about the shared radio channel: its model, its load, and the reasons why it lost messages."""
    if (found := record.channel) is None:
        return []
    mean = sum(found.load) * found.load_interval_s / record.mission_s if record.mission_s else 0.0
    preset, airtime = found.model.get("preset"), words.value(round(found.airtime_s, 1))
    sentences = [
        f"All vehicles shared one channel, {preset}, {_played_by(found)}.",
        f"There were {words.value(found.frames)} frames with an airtime of {airtime} s. "
        f"The channel was busy for {words.percent(round(mean, 3))} of the mission, and for "
        f"{words.percent(max(found.load, default=0.0))} of the busiest {words.value(found.load_interval_s)} s.",
    ]
    for reason, by_vehicle in {**found.lost, **found.dropped}.items():
        counts = ", ".join(f"{vehicle}: {words.value(count)}" for vehicle, count in by_vehicle.items())
        whose = "Frames lost by receiver" if reason in found.lost else "Messages dropped by sender"
        sentences.append(f"{whose}, {REASONS.get(reason, reason)}: {counts}.")
    if (late := found.lateness) is not None:
        too_slow = "" if late.tolerable else " The machine was too slow: repeat the run with a smaller speedup."
        sentences.append(f"{late.in_words()}, in mission time.{too_slow}")
    if late_answers := record.late_answers():
        sentences.append(f"{late_answers}.")
    return sentences


def _played_by(channel: ChannelRecord) -> str:
    return "computed in virtual time" if channel.lateness is None else "played in real time between the vehicles"


def _pairs(network: Connectivity, end_s: float) -> list[tuple[str, list[ConditionSpan]]]:
    """Return one row for each group of vehicle pairs that have equal losses over time. The row with the largest losses
    is first.

    Return no rows if all pairs have the same losses.
    """
    alike: defaultdict[tuple[tuple[float, float], ...], list[Pair]] = defaultdict(list)
    for pair, history in network.pair_losses.items():
        alike[tuple(history)].append(pair)
    if len(alike) < 2:
        return []
    lanes = []
    for states, pairs in alike.items():
        spans = steps([(at_s, _lost(loss), loss) for at_s, loss in states], end_s)
        lanes.append((sum(span.level * (span.to_s - span.from_s) for span in spans), _named(pairs), spans))
    lanes.sort(key=lambda lane: -lane[0])
    return [(name, spans) for _, name, spans in lanes[:MOST_PAIRS]]


def _lost(loss: float) -> str:
    return "no link" if loss == 1.0 else words.percent(round(loss, 2)) if quality(loss) else ""


def _named(pairs: Sequence[Pair]) -> str:
    names = ", ".join(f"{low}\u2013{high}" for low, high in pairs[:NAMED_PAIRS])
    return f"{names} and {len(pairs) - NAMED_PAIRS} more" if len(pairs) > NAMED_PAIRS else names


def _in_words(losses: LossRates) -> str:
    mean, worst = words.percent(losses.mean), words.percent(losses.worst)
    return mean if mean == worst else f"{mean}, the worst link {worst}"


def initial_state(states: Sequence[NetworkState]) -> str | None:
    """Return a description of the network at the start of the run. Return None if the network is not recorded."""
    return states[0].detail if states else None


def event_rows(record: RunRecord) -> list[tuple[str, str, str]]:
    """Return the time, name and details of each fault and operator command, in order of time."""
    rows = [(fault.at_s, fault.what, _fault_detail(fault)) for fault in record.faults]
    station, refused = record.ground_station, "; refused" if in_virtual_time(record.backend) else ""
    if station is not None:
        rows += [(command.at_s, "operator", _command_detail(command) + refused) for command in station.commands]
    rows.sort(key=lambda row: row[0])
    rows_text = [(words.duration(at_s), what, detail) for at_s, what, detail in rows]
    if station is not None and station.commands_left_out:
        rows_text.append(("later", "operator", f"{station.commands_left_out} more commands, which are not recorded"))
    return rows_text


def _fault_detail(fault: FaultRecord) -> str:
    details = [fault.detail] if fault.detail else []
    if fault.fully_connected is not None:
        details.append(f"fully connected: {words.value(fault.fully_connected)}")
    if fault.by_hand:
        details.append("caused by hand")
    return "; ".join(details)


def _command_detail(command: OperatorCommand) -> str:
    """Return a text that describes an operator command, such as "vehicle 2: MAV_CMD_DO_SET_MODE; param1 1, param2 6; 3
    times until 2:05".

    Parameters with the value 0 are left out.
    """
    vehicles = f"vehicle{'s' if len(command.vehicles) > 1 else ''} {' '.join(map(str, command.vehicles))}"
    details = [f"{vehicles}: {command.command or command.message}"]
    values = [f"{name} {words.value(value)}" for name, value in command.values.items() if value]
    if values:
        details.append(", ".join(values))
    if command.times > 1:
        details.append(f"{command.times} times until {words.duration(command.until_s)}")
    return "; ".join(details)


def ground_station(record: RunRecord) -> str | None:
    """Return a sentence about the messages between the vehicles and the ground station. Return None if there was no
    ground station.
    """
    if (station := record.ground_station) is None:
        return None
    dropped = f", and {words.value(station.dropped)} were dropped" if station.dropped else ""
    came = f"{words.value(station.received)} datagrams came from it{dropped}"
    refused = (
        " Its commands were refused, because virtual time computes the tracks."
        if in_virtual_time(record.backend)
        else ""
    )
    return (
        f"Ground station at {station.address}: {words.value(station.sent)} datagrams were sent to it, {came}.{refused}"
    )
