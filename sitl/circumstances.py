"""Simulate faults and weather of a vehicle, by parameters of ArduPilot's simulation (SIM_...).

The names of these parameters differ between versions. A fault therefore has several alternative sets of parameters. The
alternative for the current version is first. The pilot uses the first alternative whose parameters all exist. ArduPilot
answers requests for parameters in order, and does not answer a request for an unknown parameter. An answer about a
later alternative therefore shows that the parameters of the earlier alternatives do not exist. A parameter counts as
set when the vehicle reports the new value.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sitl.vehicle import VehicleError

if TYPE_CHECKING:  # a scenario names circumstances, and imports no MAVLink for it
    from sitl._pilot_link import PilotLink

ANSWER_S = 3.0
"""Maximum number of seconds to wait for an answer. If the speedup is below 1, the limit is divided by the speedup. A
vehicle answers within one main loop.
"""
ASK_AGAIN_S = 0.5
LOOK_S = 0.01

GPS_OFF = ({"SIM_GPS1_ENABLE": 0.0}, {"SIM_GPS_DISABLE": 1.0})
GPS_ON = ({"SIM_GPS1_ENABLE": 1.0}, {"SIM_GPS_DISABLE": 0.0})
FENCE_M = 2.0
"""Radius in metres to which the fence shrinks. ArduPilot allows no fence smaller than FENCE_MARGIN, which is 2 m by
default.
"""
_COMPASSES = tuple(f"SIM_MAG{number}_FAIL" for number in (1, 2, 3))


class NotSimulatedError(VehicleError):
    """An error: the vehicle cannot simulate an event, or did not confirm it."""


@dataclass(frozen=True)
class SimulatedFailure:
    """An event to simulate, such as a GPS failure. `what` names the event, and completes a sentence that begins with
    "simulate". Each element of `ways` is a set of parameters that causes the event.

    `station_is_heard` is true if the event lets the vehicle receive heartbeats of its ground station, and false if the
    event stops them. It is None if the event has no effect on heartbeats.
    """

    what: str
    ways: tuple[Mapping[str, float], ...]
    station_is_heard: bool | None = None


GPS_LOST = SimulatedFailure("the loss of its GPS", GPS_OFF)
GPS_REGAINED = SimulatedFailure("a GPS that is back", GPS_ON)
COMPASS_LOST = SimulatedFailure("the loss of its compasses", (dict.fromkeys(_COMPASSES, 1.0), {_COMPASSES[0]: 1.0}))
COMPASS_REGAINED = SimulatedFailure("compasses that are back", (dict.fromkeys(_COMPASSES, 0.0), {_COMPASSES[0]: 0.0}))
MOTOR_STOPPED = SimulatedFailure("the failure of a motor", ({"SIM_ENGINE_MUL": 0.0, "SIM_ENGINE_FAIL": 1.0},))
"""The failure of one motor. Some versions of ArduPilot use SIM_ENGINE_FAIL as the number of an output. The value 1 then
stops the second motor. Other versions use it as a bit mask. The value 1 then stops the first motor.
"""

RC_LOST = SimulatedFailure("the loss of its remote control", ({"SIM_RC_FAIL": 1.0},))
"""The loss of the remote control. If SIM_RC_FAIL is 1, the simulated receiver sends no pulses."""
RC_REGAINED = SimulatedFailure("a remote control that is back", ({"SIM_RC_FAIL": 0.0},))
STATION_LOST = SimulatedFailure("the loss of its ground station", ({},), station_is_heard=False)
STATION_REGAINED = SimulatedFailure("a ground station that is back", ({},), station_is_heard=True)
_AROUND_HOME = {"FENCE_RADIUS": FENCE_M, "FENCE_ENABLE": 1.0}
FENCE_BREACHED = SimulatedFailure(
    "a breach of its fence",
    ({"FENCE_TYPE": 3.0, "FENCE_ALT_MAX": FENCE_M, **_AROUND_HOME}, {"FENCE_TYPE": 2.0, **_AROUND_HOME}),
)
"""A breach of the fence. If FENCE_TYPE is 3, the fence is a maximum altitude and a circle around home. If it is 2, as
for a rover, the fence is only the circle.
"""
FENCE_LIFTED = SimulatedFailure("a flight without a fence", ({"FENCE_ENABLE": 0.0},))


def battery(volts: float) -> SimulatedFailure:
    """Return an event: the battery has this voltage from now on."""
    return SimulatedFailure(f"a battery of {volts:g} V", ({"SIM_BATT_VOLTAGE": volts},))


def wind(speed_ms: float, from_deg: float) -> SimulatedFailure:
    """Return an event: from now on, wind blows at this speed from this direction. The direction is in degrees clockwise
    from north.
    """
    return SimulatedFailure(f"wind of {speed_ms:g} m/s", ({"SIM_WIND_SPD": speed_ms, "SIM_WIND_DIR": from_deg},))


async def bring_about(link: PilotLink, circumstance: SimulatedFailure) -> Mapping[str, float]:
    """Make the vehicle simulate an event. Return the parameters that were set. Raises NotSimulatedError."""
    ways, limit_s = circumstance.ways, ANSWER_S / min(1.0, link.speedup)
    for way in ways:
        for name in way:
            link.parameters.pop(name, None)

    def ask_for_all() -> None:
        for way in ways:
            for name in way:
                link.request_parameter(name)

    def known() -> Mapping[str, float] | None:
        return next((way for way in ways if link.parameters.keys() >= way.keys()), None)

    asked_at = time.monotonic()
    chosen = await _await_answer(link, known, ask_for_all, limit_s)
    if link.closed.is_set():
        raise NotSimulatedError(f"ended its connection before it could simulate {circumstance.what}")
    if chosen is None and link.heard_at < asked_at:
        raise NotSimulatedError(f"did not answer the request to simulate {circumstance.what}")
    if chosen is None:
        names = " and no ".join(" with ".join(way) for way in ways)
        raise NotSimulatedError(f"cannot simulate {circumstance.what}: it has no {names}")
    values = dict(chosen)

    def set_all() -> None:
        for name, value in values.items():
            link.set_parameter(name, value)
            link.request_parameter(name)  # a vehicle does not report an unchanged value

    def came_about() -> Mapping[str, float] | None:
        return values if all(_same(link.parameters[name], value) for name, value in values.items()) else None

    if await _await_answer(link, came_about, set_all, limit_s) is None:
        said = ", ".join(f"{name} {link.parameters[name]:g}" for name in values)
        raise NotSimulatedError(f"did not simulate {circumstance.what}: after {limit_s:g} s it reports {said}")
    return values


async def _await_answer(
    link: PilotLink,
    answer: Callable[[], Mapping[str, float] | None],
    ask: Callable[[], None],
    limit_s: float,
) -> Mapping[str, float] | None:
    """Repeat a request until an answer arrives, the time limit passes or the connection ends. Return the answer or
    None.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + limit_s
    while loop.time() < deadline and not link.closed.is_set():
        ask()
        again_at = min(deadline, loop.time() + ASK_AGAIN_S)
        while loop.time() < again_at and not link.closed.is_set():
            if (heard := answer()) is not None:
                return heard
            await asyncio.sleep(LOOK_S)
    return answer()


def _same(said: float, meant: float) -> bool:
    """Return true if both values are equal as 32-bit floats."""
    return math.isclose(said, meant, rel_tol=1e-5, abs_tol=1e-5)
