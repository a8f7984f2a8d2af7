"""The embedded vehicle, a simple vehicle model that flies without an ArduPilot binary.

    python -m sitl.embedded --type plane --sysid 3 --home -35.363262,149.165237,584,270 --speedup 20

The vehicle is a small process with one thread. It needs only the standard library and a MAVLink dialect. It listens on
127.0.0.1 on the three ports of ArduPilot SITL and answers like ArduPilot. The pilot therefore does not distinguish
between the embedded vehicle and ArduPilot. Its clock runs `speedup` times as fast as wall time, but the amount of data
that it sends per second of wall time is limited. SIGTERM ends it with exit status 0.
"""

from __future__ import annotations

import argparse
import selectors
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from sitl._autopilot import Autopilot
from sitl._port import VehiclePort
from sitl.airframes import USUAL
from sitl.setup import USUAL as USUAL_SETUP
from sitl.setup import VehicleSetup
from sitl.vehicle import (
    AGENT_PORT,
    PILOT_PORT,
    STATION_PORT,
    VEHICLE_TYPES,
    Home,
    Launch,
    VehicleError,
    VehicleType,
    check_launch,
)

MIN_BATCH_INTERVAL_S = 0.05  # wall time: telemetry is sent at most 20 times per second at any speedup
MAX_SLEEP_S = 1.0  # limits the delay of landings and texts if a client has switched off all messages
MAX_DELAY_S = 0.25  # a sleep that is late by more than this means that the process was suspended


@dataclass(frozen=True)
class Embedded:
    """A kind of vehicle that runs the embedded model and needs no other program."""

    vehicle_type: VehicleType = "copter"
    setup: VehicleSetup = USUAL_SETUP
    name: str = "embedded"
    lack: str | None = None
    frame: str | None = None
    sha256: str | None = None
    uses_udp: bool = False

    @property
    def parameters(self) -> Mapping[str, float]:
        return self.setup.parameters

    def check(self) -> None:
        """Raise VehicleError if the settings need a feature that only ArduPilot has."""
        frame = self.setup.frame
        asked = {
            f"frame {frame}": frame is not None and frame != USUAL[self.vehicle_type],
            "wind": any(name.startswith("SIM_WIND_") for name in self.parameters),
            "arguments": bool(self.setup.arguments),
            "debugger": self.setup.debugger is not None,
        }
        if lacks := [what for what, needed in asked.items() if needed]:
            raise VehicleError(f"embedded vehicles have no {' and no '.join(lacks)}: fly ArduPilot, or leave it out")

    def launch(self, sysid: int, home: Home, speedup: float, directory: Path) -> Launch:
        """Return the command that starts the embedded vehicle. The embedded vehicle needs no files in `directory`.
        Raises VehicleError.
        """
        check_launch(sysid, home, speedup)
        return Launch(
            [
                *(sys.executable, "-P", "-m", "sitl.embedded"),
                *("--type", self.vehicle_type),
                *("--sysid", str(sysid)),
                f"--home={home}",  # one argument, because a southern latitude begins with a minus sign
                *("--speedup", f"{speedup:g}"),
            ]
        )


class _OptionParser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Print an error as one sentence, without the usage text of the program."""
        self.exit(2, f"{self.prog}: {message}\n")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = _OptionParser(prog="sitl.embedded", description="A small MAVLink vehicle that flies without ArduPilot.")
    parser.add_argument("--type", choices=VEHICLE_TYPES, default="copter")
    parser.add_argument("--sysid", type=int, required=True, help="MAVLink system ID, 1 to 255")
    parser.add_argument("--home", required=True, metavar="LAT,LON,ALT,HDG", help="degrees, metres above sea level")
    parser.add_argument("--speedup", type=float, default=1.0, help="simulated seconds per second")
    parser.add_argument("--pilot-port", type=int, default=PILOT_PORT)
    parser.add_argument("--agent-port", type=int, default=AGENT_PORT)
    parser.add_argument("--station-port", type=int, default=STATION_PORT)
    # `--home -35.3,...` reads like an option to argparse; join the two words
    words = list(sys.argv[1:] if argv is None else argv)
    for at in reversed(range(len(words) - 1)):
        if words[at] == "--home":
            words[at : at + 2] = [f"--home={words[at + 1]}"]
    arguments = parser.parse_args(words)
    try:
        arguments.home = Home.parse(arguments.home)
        check_launch(arguments.sysid, arguments.home, arguments.speedup)
    except VehicleError as error:
        parser.error(str(error))
    return arguments


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Fly until SIGTERM. Exit with status 2 and one sentence for wrong arguments or unavailable ports."""
    arguments = _arguments(argv)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    autopilot = Autopilot(arguments.sysid, arguments.home, time.time_ns() // 1000, arguments.type)
    selector = selectors.DefaultSelector()
    ports = []
    for number in (arguments.pilot_port, arguments.agent_port, arguments.station_port):
        try:
            ports.append(VehiclePort(number, autopilot, selector))
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) else "a port is 0 to 65535"
            sys.exit(_report_unavailable_port(arguments.sysid, number, str(reason)))
    _fly(autopilot, ports, selector, arguments.speedup)


def _report_unavailable_port(sysid: int, port: int, reason: str) -> int:
    message = (
        f"vehicle {sysid}: cannot listen on 127.0.0.1:{port}: {reason}; end the process that listens there, or choose "
        "another port\n"
    )
    sys.stderr.write(message)
    return 2


class _BootClock:
    """The simulated seconds since boot. They do not advance while the process is suspended, as in ArduPilot."""

    def __init__(self, speedup: float) -> None:
        self._speedup = speedup
        self._read_at = time.monotonic()
        self.now_s = 0.0

    def read(self, slept_s: float) -> float:
        """Return the time on the clock after the process slept for `slept_s` seconds.

        If the time that has really passed is much longer, the process was suspended. The clock does not count the
        additional time.
        """
        at = time.monotonic()
        self.now_s += min(at - self._read_at, slept_s + MAX_DELAY_S) * self._speedup
        self._read_at = at
        return self.now_s


def _fly(
    autopilot: Autopilot, ports: Sequence[VehiclePort], selector: selectors.BaseSelector, speedup: float
) -> NoReturn:
    clock = _BootClock(speedup)
    next_batch = time.monotonic()
    while True:
        due_s = [port.channel.next_due_s() for port in ports if port.channel]
        sleep_s = MAX_SLEEP_S
        if due_s:
            until_due_s = (min(due_s) - clock.now_s) / speedup
            sleep_s = max(0.0, min(sleep_s, max(until_due_s, next_batch - time.monotonic())))
        events = selector.select(sleep_s)
        autopilot.advance(clock.read(sleep_s))
        for key, mask in events:
            key.data(mask)
        now = time.monotonic()
        if now >= next_batch:
            next_batch = now + MIN_BATCH_INTERVAL_S
            for port in ports:
                if port.channel:
                    port.channel.send_due()
        for port in ports:
            port.send()


if __name__ == "__main__":
    main()
