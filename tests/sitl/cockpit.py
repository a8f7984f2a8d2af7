"""Run the autopilot of an embedded vehicle in the test's process.

The vehicle has one client, and a clock that the test advances.
"""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import Autopilot
from sitl._kinematics import LocalPlace
from sitl._mission_upload import MissionItems
from sitl._route import route
from sitl.modes import MODES
from sitl.plan import Plan
from sitl.serial_channel import ClientChannel
from sitl.vehicle import VehicleType
from tests.sitl.flying import HOME

ACCEPTED, FAILED, UNSUPPORTED = (
    mavlink.MAV_RESULT_ACCEPTED,
    mavlink.MAV_RESULT_FAILED,
    mavlink.MAV_RESULT_UNSUPPORTED,
)


class Cockpit:
    """A vehicle with one client. `heard` contains all messages that the vehicle has sent, except telemetry."""

    def __init__(self, vehicle_type: VehicleType = "copter") -> None:
        self.vehicle = Autopilot(3, HOME, 0, vehicle_type)
        self.channel = ClientChannel(self.vehicle)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._parser = mavlink.MAVLink(None)
        self.heard: list[Any] = []

    def tell(self, message: Any) -> list[Any]:
        """Send a message to the vehicle, and return its direct answers."""
        self.channel.receive(message.pack(self._mav))
        return self.listen()

    def listen(self) -> list[Any]:
        news = self._parser.parse_buffer(self.channel.take()) or []
        self.heard += news
        return news

    def command(self, command: int, *params: float) -> int:
        """Send a COMMAND_LONG, and return its result code (MAV_RESULT)."""
        padded = [*params, *[0.0] * (7 - len(params))]
        answers = self.tell(mavlink.MAVLink_command_long_message(3, 1, command, 0, *padded))
        (ack,) = [answer for answer in answers if answer.get_type() == "COMMAND_ACK"]
        return int(ack.result)

    def mode(self, name: str) -> int:
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, MODES[self.vehicle.vehicle_type][name])

    def arm(self) -> int:
        return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def fly(self, until_s: float, step_s: float = 1.0) -> None:
        """Advance the time in small steps."""
        while self.vehicle.now_s < until_s:
            self.vehicle.advance(min(until_s, self.vehicle.now_s + step_s))
            self.listen()

    def ready(self) -> None:
        self.fly(12.0)

    def take_off(self, altitude_m: float = 20.0) -> None:
        """Let a copter take off in GUIDED mode to an altitude."""
        self.ready()
        assert (self.mode("GUIDED"), self.arm()) == (ACCEPTED, ACCEPTED)
        assert self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m) == ACCEPTED
        self.fly(40.0)

    def load(self, plan: Plan) -> MissionItems:
        """Upload a plan item by item, as the vehicle requests it."""
        vehicle_type = self.vehicle.vehicle_type
        mission = MissionItems(route(plan, vehicle_type, HOME.heading_deg), HOME, 3, vehicle_type)
        answers = self.tell(mavlink.MAVLink_mission_count_message(3, 1, len(mission.items)))
        while answers[0].get_type() == "MISSION_REQUEST_INT":
            answers = self.tell(mission.items[answers[0].seq])
        assert answers[0].type == mavlink.MAV_MISSION_ACCEPTED
        return mission

    def begin(self, plan: Plan) -> float:
        """Start a plan in AUTO mode, and return the time of its start in seconds."""
        self.ready()
        self.load(plan)
        if self.vehicle.vehicle_type == "copter":
            assert (self.mode("GUIDED"), self.arm()) == (ACCEPTED, ACCEPTED)
            assert self.command(mavlink.MAV_CMD_MISSION_START) == ACCEPTED
        else:
            assert (self.mode("AUTO"), self.arm()) == (ACCEPTED, ACCEPTED)
        return self.vehicle.now_s

    @property
    def place(self) -> LocalPlace:
        return self.vehicle.motion.point

    def texts(self) -> list[str]:
        return [message.text for message in self.heard if message.get_type() == "STATUSTEXT"]

    def reached(self) -> list[int]:
        return [message.seq for message in self.heard if message.get_type() == "MISSION_ITEM_REACHED"]
