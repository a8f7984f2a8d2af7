"""Request the version and all parameters of a vehicle after it has booted.

A vehicle that does not report some parameters can still fly. It must report the parameters that the user has set.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from itertools import islice

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._pilot_link import PilotLink
from sitl.procedure import HEARTBEAT, ProcedureStep

PATIENCE = 10
"""If the vehicle sends this number of heartbeats but does not answer a request, the pilot gives up the request."""
MOST_AT_ONCE = 50

_VERSION = ProcedureStep("its version")
_LIST = ProcedureStep("its list of parameters", 180.0)
_GIVEN = ProcedureStep("the parameters that it was given")


class VehicleIntroduction:
    """The procedure that requests the version and the parameters of a vehicle. It also sets the parameters in `given`
    to the given values. The vehicle must have these parameters.
    """

    purpose = "introduce itself"

    def __init__(self, link: PilotLink, given: Mapping[str, float]) -> None:
        self._link = link
        self._given = given
        self._asked: Counter[ProcedureStep] = Counter()
        self._listed = 0

    def next_step(self) -> ProcedureStep | None:
        link = self._link
        if not link.heartbeats:
            return HEARTBEAT
        lacks = {
            _VERSION: link.state.version is None,
            _LIST: not link.has_listed_parameters,
            _GIVEN: any(link.parameters.get(name) != _as_float(value) for name, value in self._given.items()),
        }
        return next((step for step, lacking in lacks.items() if lacking and self._asked[step] < PATIENCE), None)

    def ask(self, step: ProcedureStep) -> None:
        link = self._link
        self._asked[step] += 1
        if step is _VERSION:
            link.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        elif step is _LIST:
            self._ask_for_list()
        elif step is _GIVEN:
            for name, value in self._given.items():
                if name in link.parameters:
                    link.set_parameter(name, value)
                link.request_parameter(name)  # ArduPilot's list omits the parameters of groups that are switched off

    def _ask_for_list(self) -> None:
        """Request the list of all parameters until the first parameter arrives. When no more parameters arrive, request
        the missing parameters one by one.
        """
        link = self._link
        if link.parameter_count is None:
            link.request_parameters()
        elif len(link.listed) > self._listed:
            self._asked[_LIST] = 1
        else:
            missing = (index for index in range(link.parameter_count) if index not in link.listed)
            for index in islice(missing, MOST_AT_ONCE):
                link.request_parameter_at(index)
        self._listed = len(link.listed)


def _as_float(value: float) -> float:
    """Return the value rounded to a 32-bit float, which is the precision of MAVLink."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])
