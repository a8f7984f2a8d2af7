"""Connect one client to the embedded vehicle. The connection transports MAVLink without a socket, and corresponds to
one serial port of ArduPilot.

Each `ClientChannel` has its own parser, sequence numbers, message intervals and incomplete mission.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl._autopilot import FRAMES, MAX_ALTITUDE_M, Autopilot
from sitl._mission_inbox import MissionInbox
from sitl.modes import MODES
from sitl.streams import ON_REQUEST, STREAMS

DEFAULT_INTERVAL_S = 1.0
MIN_INTERVAL_S = 0.02

LOG_DATA_BYTES = 90
FTP_BYTES, FTP_NAK, FTP_UNKNOWN_COMMAND = 251, 129, 7

FORCE = 21196  # param2 of MAV_CMD_COMPONENT_ARM_DISARM
NO_POSITION = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
)
TAKE_OFF_ALTITUDE = "TKOFF_ALT"  # only for a plane; _failsafes.py has the other parameters
SYSTEM_ID = "SYSID_THISMAV"


class ClientChannel:
    """The connection of one client to an autopilot, from its beginning to its end."""

    def __init__(self, autopilot: Autopilot) -> None:
        self._autopilot = autopilot
        self._mav = mavlink.MAVLink(None, srcSystem=autopilot.sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True  # garbage is reported as BAD_DATA, not raised
        self._out = bytearray()
        self._mission = MissionInbox(autopilot)
        self._interval_s = dict.fromkeys(STREAMS, DEFAULT_INTERVAL_S)
        self._due_s = dict.fromkeys(STREAMS, autopilot.now_s)
        autopilot.listeners.append(self)

    def close(self) -> None:
        self._autopilot.listeners.remove(self)

    def receive(self, data: bytes) -> None:
        """Process bytes from the client. The bytes may be invalid, and may begin or end inside a message."""
        for message in self._mav.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "HEARTBEAT":
                self._autopilot.hear(message.get_srcSystem())
            if getattr(message, "target_system", None) not in (0, self._autopilot.sysid):
                continue  # BAD_DATA and heartbeats have no target
            if getattr(message, "target_component", 0) not in (0, mavlink.MAV_COMP_ID_AUTOPILOT1):
                continue
            if kind in ("COMMAND_LONG", "COMMAND_INT"):
                self._acknowledge(message, self._command(message))
            elif kind == "SET_POSITION_TARGET_GLOBAL_INT":
                self._position_target(message)
            elif kind == "PARAM_SET":
                self._set_parameter(message)
            elif kind in ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ"):
                self._tell_parameters(message)
            elif kind == "REQUEST_DATA_STREAM":
                self._set_rate(message)
            elif kind == "FILE_TRANSFER_PROTOCOL":
                self._refuse_file(message)
            elif kind == "LOG_REQUEST_LIST":
                self.send(mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0))
            elif kind == "LOG_REQUEST_DATA":
                self.send(mavlink.MAVLink_log_data_message(message.id, message.ofs, 0, [0] * LOG_DATA_BYTES))
            elif kind.startswith("MISSION_"):
                for answer in self._mission.receive(kind, message):
                    self.send(answer)
        # the parser frees its buffer only when a read ends with a message
        del self._mav.buf[: self._mav.buf_index]
        self._mav.buf_index = 0

    def send(self, message: Any) -> None:
        self._out += message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256

    def send_due(self) -> None:
        """Send each message whose time has come. If a message is due several times because the last call was long ago,
        send it only once, with the current state.
        """
        now_s = self._autopilot.now_s
        for message_id, due_s in self._due_s.items():
            if due_s <= now_s:
                self.send(STREAMS[message_id](self._autopilot))
                self._due_s[message_id] = max(due_s + self._interval_s[message_id], now_s)

    def next_due_s(self) -> float:
        return min(self._due_s.values())

    def take(self) -> bytes:
        """Return the bytes to send to the client."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def _acknowledge(self, message: Any, result: int) -> None:
        self.send(
            mavlink.MAVLink_command_ack_message(
                message.command,
                result,
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            )
        )

    def _command(self, message: Any) -> int:
        """Execute a COMMAND_LONG or COMMAND_INT, and return its result code (MAV_RESULT)."""
        vehicle = self._autopilot
        match message.command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM if message.param1 == 1:
                return vehicle.arm()
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                return vehicle.disarm(force=message.param2 == FORCE)
            case mavlink.MAV_CMD_DO_FLIGHTTERMINATION if message.param1 > 0.5:
                return vehicle.disarm(force=True)
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                return vehicle.take_off(_parameter_7(message))
            case mavlink.MAV_CMD_NAV_LAND:
                return self._set_mode("LAND")
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return self._set_mode("RTL")
            case mavlink.MAV_CMD_DO_SET_MODE:
                return vehicle.set_mode(message.param2)
            case mavlink.MAV_CMD_MISSION_START:
                return vehicle.start_mission()
            case mavlink.MAV_CMD_DO_CHANGE_SPEED:
                return vehicle.set_speed(message.param2)
            case mavlink.MAV_CMD_DO_REPOSITION:
                return self._reposition(message)
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self._set_interval(message.param1, message.param2)
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request(message.param1)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return self._request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            case mavlink.MAV_CMD_GET_HOME_POSITION:
                return self._request(mavlink.MAVLINK_MSG_ID_HOME_POSITION)
        return int(mavlink.MAV_RESULT_UNSUPPORTED)

    def _set_mode(self, name: str) -> int:
        number = MODES[self._autopilot.vehicle_type].get(name)
        return int(mavlink.MAV_RESULT_UNSUPPORTED) if number is None else self._autopilot.set_mode(number)

    def _reposition(self, message: Any) -> int:
        """Execute MAV_CMD_DO_REPOSITION, and return its result code. In the message, param1 is the speed, and param2
        may request GUIDED mode.
        """
        vehicle = self._autopilot
        if message.get_type() != "COMMAND_INT":
            return int(mavlink.MAV_RESULT_COMMAND_INT_ONLY)
        if message.frame not in FRAMES:
            return int(mavlink.MAV_RESULT_DENIED)
        if math.isfinite(message.param2) and int(message.param2) & mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE:
            self._set_mode("GUIDED")
        if message.param1 > 0:
            vehicle.set_speed(message.param1)
        return vehicle.go_to(vehicle.place(message.frame, message.x, message.y, message.z))

    def _position_target(self, message: Any) -> None:
        """Process a message that contains a complete target position. The vehicle sends no answer to this message. A
        plane ignores the message, as ArduPlane does.
        """
        vehicle = self._autopilot
        whole = not message.type_mask & NO_POSITION and message.coordinate_frame in FRAMES
        if whole and vehicle.vehicle_type != "plane":
            vehicle.go_to(vehicle.place(message.coordinate_frame, message.lat_int, message.lon_int, message.alt))

    def _set_parameter(self, message: Any) -> None:
        """Set a parameter. If the parameter is unknown, send no answer, as ArduPilot does."""
        vehicle, name, value = self._autopilot, message.param_id, message.param_value
        if name == TAKE_OFF_ALTITUDE and vehicle.vehicle_type == "plane":
            if 0 < value <= MAX_ALTITUDE_M:
                vehicle.take_off_altitude_m = value
        elif name not in vehicle.failsafes.parameters:
            return
        elif math.isfinite(value):
            vehicle.simulate(name, value)
        self.send(self._parameters()[name])

    def _parameters(self) -> dict[str, object]:
        """Return the message PARAM_VALUE for each parameter. A ground station requests all parameters before it shows a
        vehicle.
        """
        values: dict[str, float] = {SYSTEM_ID: self._autopilot.sysid}
        if self._autopilot.vehicle_type == "plane":
            values[TAKE_OFF_ALTITUDE] = self._autopilot.take_off_altitude_m
        values |= self._autopilot.failsafes.parameters
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        return {
            name: mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(values), at)
            for at, (name, value) in enumerate(values.items())
        }

    def _tell_parameters(self, message: Any) -> None:
        parameters = self._parameters()
        wanted = set(parameters)
        if message.get_type() == "PARAM_REQUEST_READ":
            by_index = dict(enumerate(parameters))
            index: int = message.param_index
            wanted = {by_index.get(index, "") if index >= 0 else str(message.param_id)}
        for name, value in parameters.items():
            if name in wanted:
                self.send(value)

    def _set_rate(self, message: Any) -> None:
        """Execute REQUEST_DATA_STREAM of older ground stations: set the rate of all messages except the heartbeat."""
        rate = message.req_message_rate if message.start_stop else 0
        for message_id in STREAMS:
            if message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                self._set_interval(message_id, 1e6 / rate if rate else -1)

    def _set_interval(self, message_id: float, interval_us: float) -> int:
        """Execute MAV_CMD_SET_MESSAGE_INTERVAL, and return its result code. The interval is in microseconds.

        An interval of 0 stands for the default interval. A negative interval stops the message.
        """
        if message_id not in STREAMS or not math.isfinite(interval_us):
            return int(mavlink.MAV_RESULT_FAILED)
        if interval_us < 0:
            interval_s = math.inf
        elif interval_us == 0:
            interval_s = DEFAULT_INTERVAL_S
        else:
            interval_s = max(MIN_INTERVAL_S, interval_us / 1e6)
        self._interval_s[int(message_id)] = interval_s
        next_s = self._autopilot.now_s + interval_s
        self._due_s[int(message_id)] = next_s if interval_us < 0 else min(next_s, self._due_s[int(message_id)])
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _request(self, message_id: float) -> int:
        if message_id not in ON_REQUEST:
            return int(mavlink.MAV_RESULT_FAILED)
        self.send(ON_REQUEST[int(message_id)](self._autopilot))
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _refuse_file(self, message: Any) -> None:
        """Refuse a request of MAVLink FTP, because the vehicle has no files.

        A payload has these fields: sequence number (two bytes), session, operation, size, requested operation, two
        bytes that are not used here, offset (four bytes), and data. The data is an error number here.
        https://mavlink.io/en/services/ftp.html
        """
        sequence = (int.from_bytes(bytes(message.payload[:2]), "little") + 1) & 0xFFFF
        session, operation = message.payload[2:4]
        head = [*sequence.to_bytes(2, "little"), session, FTP_NAK, 1, operation, 0, 0, 0, 0, 0, 0, FTP_UNKNOWN_COMMAND]
        payload = head + [0] * (FTP_BYTES - len(head))
        self.send(
            mavlink.MAVLink_file_transfer_protocol_message(
                0, message.get_srcSystem(), message.get_srcComponent(), payload
            )
        )


def _parameter_7(message: Any) -> float:
    """Return parameter 7 of a command, the altitude. In a COMMAND_INT it has the name z."""
    return float(message.z if message.get_type() == "COMMAND_INT" else message.param7)
