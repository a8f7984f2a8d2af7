"""Run one agent as a process: `python -m ucp.node MISSION_FILE`. With `--virtual`, run `ucp.virtual` instead.

The process drives `ucp.agent.Agent` with a UDP broadcast socket, the clock, and an event source. It writes the files
`<id>.chain.json`, `<id>.trace.jsonl` and `<id>.log` next to the mission file, and a store if the mission names one.
While it runs, its control socket `<id>.control` is there too. On SIGTERM the process exports the chain and ends.
contract/CONTRACT.md defines the behaviour of every agent under test. The harness uses this agent by default.
"""

import base64
import contextlib
import signal
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, cast

from ucp._drop_quota import DropQuota
from ucp._status import status_of
from ucp.agent import Agent
from ucp.agent_files import LogFile, ReservedSpace, TraceFile, write_json_atomically
from ucp.clock import MissionClock
from ucp.control import CommandError, ControlServer, UnsupportedCommandError
from ucp.events import EVENT_HEADER_BYTES, LoggableEvent, RandomEvents
from ucp.export import export_chain
from ucp.features import UNSUPPORTED
from ucp.loop import Loop, ScheduledCall
from ucp.messages import MalformedDatagramError
from ucp.mission import Mission, MissionError, UnsupportedMissionError, is_epoch, load_mission
from ucp.store import Store, StoreError
from ucp.trace import CommandEntry, DroppedDatagram, Entry, HandlerRun, header_line

if TYPE_CHECKING:
    from ucp.secure.secured_agent import SecuredAgent
    from ucp.telemetry import TelemetryEvents

MAX_READ_BYTES = 65536
DATAGRAMS_PER_TURN = 64
WRONG_MISSION = 2


class Node:
    """An agent with its socket, files, clock and event source.

    Its files are in `directory`. `loop` replaces the main loop. The example contract/examples/ros2 passes a loop that
    runs on rclpy. Raises OSError if the port or a file cannot be opened, StoreError if the store belongs to another
    agent, and MissionError for unusable keys.
    """

    def __init__(self, mission: Mission, directory: Path, loop: Loop | None = None) -> None:
        self.mission = mission
        self._log_file = LogFile(directory / f"{mission.agent_id}.log")
        self.clock = MissionClock(mission.speedup)
        self._rng = Random(mission.seed)  # the random draws of its quirks
        self.agent = self._agent_factory(mission, directory)(
            mission.agent_id,
            mission.roster,
            mission.initial_data,
            mission.settings,
        )
        if any(mission.quirks.values()):
            self._apply_quirks()
        self._secured = None if mission.security is None else cast("SecuredAgent", self.agent)
        self.generating = False
        self.handled = 0
        self.bytes_sent = 0
        self.send_failures = 0
        self._joined_s = 0.0  # mission seconds at which the agent joined a mission that was under way
        self._directory = directory
        self._trace = TraceFile(directory / f"{mission.agent_id}.trace.jsonl")
        self._drop_quota = DropQuota()
        self._export_space = ReservedSpace(directory)
        self._store = Store(directory / mission.store, self.agent.state) if mission.store else None
        self._socket = _broadcast_socket(mission)
        self._loop = Loop() if loop is None else loop
        self._loop.on_error = self._log_exception
        self._timer: ScheduledCall | None = None
        self._telemetry = self._prepared_telemetry()
        self._close_source: Callable[[], object] = lambda: None
        self._control = ControlServer(
            directory / f"{mission.agent_id}.control",
            {
                "status": self._status,
                "start": self._start,
                "log": self._log,
                "stop_events": self._stop_events,
                "export": self._export_command,
                "quirk": self._quirk,
                "reconcile": self._reconcile,
                **({} if self._secured is None else {"revoke": self._revoke}),
            },
            self._loop,
        )

    def _agent_factory(self, mission: Mission, directory: Path) -> "Callable[..., Agent]":
        if mission.security is None:
            return Agent
        try:
            from ucp.secure._secured_vehicle import agent_factory  # needs the extra `secure`
        except ModuleNotFoundError as error:
            raise UnsupportedMissionError(
                f"needs the feature 'secured', and {error.name} is not installed here"
            ) from None

        def report_write_error(error: OSError) -> None:
            self._log_line(f"the bundle is out of date, and may have an old group secret: {error.strerror}")

        return agent_factory(mission, directory, report_write_error)

    def run(self) -> int:
        """Run until the process receives SIGTERM, SIGINT or SIGHUP. Return the exit status, which is 1 if the chain
        could not be exported.
        """
        ending = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
        self._loop.stop_on(*(number for number in ending if signal.getsignal(number) is not signal.SIG_IGN))
        self._loop.watch(self._socket, readable=self._receive)
        self._control.start()
        self._log_line(f"agent {self.mission.agent_id} of {list(self.mission.roster)} ready")
        if self.mission.epoch_us is not None:
            self._begin(self.mission.epoch_us)
        self._loop.run()
        self._stop_source()
        self._socket.close()
        status = 0
        try:
            self.export()
        except OSError as error:
            self._log_line(f"could not export the chain: {error.strerror}")
            status = 1
        self._trace.close()
        if self._store is not None:
            self._store.close()
        self._control.close()
        self._loop.close()
        self._log_line(f"agent {self.mission.agent_id} ended")
        return status

    def _log_exception(self, error: Exception) -> None:
        """Log an exception of a handler. The agent then continues, because its end would affect the other agents."""
        import traceback

        self._log_line("".join(traceback.format_exception(error)).rstrip())

    def export(self) -> Path:
        """Write the chain export, completely or not at all, and return its path. Raises OSError."""
        path = self._directory / f"{self.mission.agent_id}.chain.json"
        now = self.clock.now()
        at_us, secured = self.clock.timestamp_us(now), self._secured
        document = export_chain(self.agent.state, at_us) if secured is None else secured.signed_export(at_us)
        self._record_entries([*self._drop_quota.counts(now)])
        try:
            write_json_atomically(path, document)
        except OSError:
            if not self._export_space.release():
                raise
            write_json_atomically(path, document)
        return path

    def _apply_quirks(self) -> None:
        from ucp.quirks import wrong_handlers

        self.agent.replace_handlers(wrong_handlers(self.mission.quirks, self._rng))

    def _log_line(self, sentence: str) -> None:
        self._log_file.write_line(sentence)

    # Inputs of the agent

    def _receive(self) -> None:
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data, (address, _) = self._socket.recvfrom(MAX_READ_BYTES)
            except OSError:  # no further datagram, or the network is down for a while
                return
            if address == self.mission.network.address or not self.clock.running:
                continue  # the agent's own broadcast
            self._feed(partial(self.agent.receive_datagram, data))

    def log_event(self, event_id: int, data: bytes) -> None:
        """Log an event. Events before the start and after the end of the mission are ignored."""
        if not self.generating:
            return
        event = LoggableEvent(self.clock.timestamp_us(self.clock.now()), event_id, data)
        try:
            self._feed(partial(self.agent.add_event, event))
        except ValueError as error:  # larger than this mission allows
            self._log_line(f"event {event_id} not logged: {error}")

    def _handle_timer(self) -> None:
        self._timer = None
        self._feed(self.agent.handle_timer)

    def _feed(self, feed: Callable[[float], None]) -> None:
        """Give the agent one input. Then write its records, broadcast its messages, and set its next timer.

        The node writes store and trace before it broadcasts, because the process can be killed between these steps. For
        a dropped datagram, the node only writes the trace, because the datagram changes neither the store nor a timer.
        This saves time if a sender causes many drops.
        """
        feed(self.clock.now())
        entries, datagrams = self.agent.trace(), self.agent.datagrams_to_send()
        if not datagrams and entries and all(isinstance(entry, DroppedDatagram) for entry in entries):
            self._write_trace(self._within_quota(entries))
            return
        self._record_entries([*self._within_quota(entries)])
        for datagram in datagrams:
            try:
                self._socket.sendto(datagram, (self.mission.network.broadcast, self.mission.network.port))
                self.bytes_sent += len(datagram)
            except OSError as error:  # the message is lost, as with a radio that cannot send
                self.send_failures += 1
                self._log_line(f"could not broadcast: {error.strerror}")
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        deadline = self.agent.next_timer()
        if deadline is not None:
            delay = self.clock.wall_s(deadline - self.clock.now())
            self._timer = self._loop.call_later(delay, self._handle_timer)

    def _record_entries(self, entries: list[Entry]) -> None:
        runs = [entry for entry in entries if isinstance(entry, HandlerRun)]
        self.handled += len(runs)
        if self._store is not None and self._store.problem is None:
            secured = None if self._secured is None else self._secured.secured_state()
            self._store.write([change for run in runs for change in run.changes], secured)
            if self._store.problem:
                self._log_line(f"the store ends here: {self._store.problem}")
        self._write_trace(entries)

    def _write_trace(self, entries: Iterable[Entry]) -> None:
        if self._trace.problem is None and (lines := "".join(entry.to_line() for entry in entries)):
            self._trace.write(lines)
            if self._trace.problem:
                self._log_line(f"the trace ends here: {self._trace.problem}")

    def _within_quota(self, entries: list[Entry]) -> Iterator[Entry]:
        for entry in entries:
            if isinstance(entry, DroppedDatagram):
                yield from self._drop_quota.lines(entry)
            else:
                yield entry

    # Event sources

    def _begin(self, epoch_us: int) -> None:
        self.clock.start(epoch_us)
        if self.mission.epoch_us is not None:
            self._joined_s = self.clock.now()
        self._trace.write(
            header_line(
                self.mission.agent_id,
                list(self.mission.roster),
                self.mission.initial_data,
                self.mission.settings.to_json(),
                {"epoch_us": epoch_us, "speedup": self.mission.speedup},
                self._secured is not None,
            )
        )
        if self._store is not None and self._store.recovered is not None:
            self._feed(partial(self.agent.boot, self._store.recovered))
            self._log_line(f"went on from a store of {len(self.agent.state.chain)} blocks")
        self.generating = True
        if self.mission.events.source == "random":
            self._schedule_random_event(RandomEvents(Random(self.mission.seed), self.mission.events.mean_s))
        elif self._telemetry is not None:
            self._connect_vehicle(self._telemetry)
        self._log_line(f"mission started, events from {self.mission.events.source}")

    def _schedule_random_event(self, source: RandomEvents) -> None:
        due, event_id, data = source.next()

        def log() -> None:
            self._schedule_random_event(source)
            self.log_event(event_id, data)

        expected = self._loop.call_later(self.clock.wall_s(self._joined_s + due - self.clock.now()), log)
        self._close_source = expected.cancel

    def _prepared_telemetry(self) -> "TelemetryEvents | None":
        """Return the converter for the telemetry of the vehicle. Return None if the events do not come from a vehicle.

        The agent creates the converter before the mission starts, because the import of MAVLink needs half a second of
        processor time.
        """
        source = self.mission.events
        if source.source != "mavlink":
            return None
        from ucp.telemetry import TelemetryEvents

        return TelemetryEvents(source.position_interval_s, Random(self.mission.seed), source.log)

    def _connect_vehicle(self, telemetry: "TelemetryEvents") -> None:
        from ucp.telemetry import VehicleConnection  # only missions with a vehicle load it

        source = self.mission.events

        def sink(data: bytes) -> None:
            for event_id, event_data in telemetry.receive(data, self.clock.now()):
                self.log_event(event_id, event_data)

        self._close_source = VehicleConnection(self._loop, source.vehicle_host, source.vehicle_port, sink).close

    def _stop_source(self) -> None:
        self.generating = False
        self._close_source()

    # Commands of the control socket

    def _status(self, request: dict[str, Any]) -> dict[str, Any]:
        return {
            **status_of(self.agent),
            "started": self.clock.running,
            "mission_s": round(self.clock.now(), 3),
            "generating": self.generating,
            "handled": self.handled,
            "bytes_sent": self.bytes_sent,
            "send_failures": self.send_failures,
            "trace_problem": self._trace.problem,
        }

    def _start(self, request: dict[str, Any]) -> dict[str, Any]:
        epoch_us = request.get("epoch_us")
        if not is_epoch(epoch_us):
            raise CommandError("start needs `epoch_us`, microseconds since the Unix epoch")
        if self.clock.running:
            raise CommandError("the mission has started already")
        self._begin(epoch_us)
        return {}

    def _log(self, request: dict[str, Any]) -> dict[str, Any]:
        event_id, data = request.get("event_id"), request.get("data")
        if not self.clock.running:
            raise CommandError("the mission has not started")
        if type(event_id) is not int or not 1 <= event_id <= 254 or not isinstance(data, str):
            raise CommandError("log needs `event_id`, 1 to 254, and `data`, in base64")
        try:
            event_data = base64.b64decode(data, validate=True)
        except ValueError:
            raise CommandError("log needs `data` in base64") from None
        largest = self.mission.settings.max_event_bytes - EVENT_HEADER_BYTES
        if len(event_data) > largest:
            raise CommandError(f"an event of this mission has at most {largest} bytes of data, not {len(event_data)}")
        self.log_event(event_id, event_data)
        return {}

    def _stop_events(self, request: dict[str, Any]) -> dict[str, Any]:
        self._stop_source()
        self._trace_command(request)
        return {}

    def _export_command(self, request: dict[str, Any]) -> dict[str, Any]:
        self._trace_command(request)
        try:
            return {"path": str(self.export())}
        except OSError as error:
            self._log_line(f"could not export the chain: {error.strerror}")
            raise CommandError(f"could not export the chain: {error.strerror}") from None

    def _quirk(self, request: dict[str, Any]) -> dict[str, Any]:
        name: str = str(request.get("name"))
        value: Any = request.get("value")
        from ucp.quirks import UnknownQuirkError, check_quirk  # correct agents do not load quirks

        try:
            check_quirk(name, value)
        except UnknownQuirkError as error:
            raise UnsupportedCommandError(str(error)) from None
        except ValueError as error:
            raise CommandError(str(error)) from None
        self.mission.quirks[name] = value
        self._apply_quirks()
        self._trace_command(request)
        return self.mission.quirks

    def _trace_command(self, request: dict[str, Any]) -> None:
        """Write to the trace a command that triggers no handler. Do nothing before the start of the mission."""
        if self.clock.running:
            self._record_entries([CommandEntry(self.clock.now(), str(request.get("command")), request)])

    def _revoke(self, request: dict[str, Any]) -> dict[str, Any]:
        revocation = request.get("revocation")
        agent = self._secured
        assert agent is not None, "only secured agents have this command"
        if not self.clock.running:
            raise CommandError("the mission has not started")
        try:
            body = base64.b64decode(revocation, validate=True)  # type: ignore[arg-type]

            def revoke(now: float) -> None:
                agent.revoke(body, now)

            self._feed(revoke)
        except (TypeError, ValueError) as error:
            why = str(error) if isinstance(error, MalformedDatagramError) else "not in base64"
            raise CommandError(f"no revocation: {why}") from None
        return {"revoked": sorted(agent.revoked)}

    def _reconcile(self, request: dict[str, Any]) -> dict[str, Any]:
        if not self.clock.running:
            raise CommandError("the mission has not started")
        self._feed(self.agent.begin_reconcile)
        return {}


def _broadcast_socket(mission: Mission) -> socket.socket:
    """Return a socket that receives broadcasts on the port of the mission. Raises OSError with the port in its
    message.
    """
    port = mission.network.port
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        sock.bind(("", port))
    except OSError as error:
        sock.close()
        way_out = "another agent may be running here, or choose another port"
        raise OSError(error.errno, f"{error.strerror}; {way_out}", f"UDP port {port}") from None
    return sock


def main(arguments: list[str], node: Callable[[Mission, Path], Node] = Node) -> int:
    """Run an agent, and return its exit status. The status is 0 on success, and 1 if the chain could not be exported.
    It is 2 if the mission is invalid or the port is in use. It is 127 if the mission needs a feature that the agent
    lacks.
    """
    if arguments == ["--virtual"]:
        from ucp.virtual import main as serve

        return serve()
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m ucp.node MISSION_FILE, or --virtual\n")
        return WRONG_MISSION
    path = Path(arguments[0])
    try:
        mission = load_mission(path)
    except MissionError as error:
        sys.stderr.write(f"{error}\n")
        return UNSUPPORTED if isinstance(error, UnsupportedMissionError) else WRONG_MISSION

    try:
        return node(mission, path.parent).run()
    except MissionError as error:
        sys.stderr.write(f"{path}: {error}\n")
        return UNSUPPORTED if isinstance(error, UnsupportedMissionError) else WRONG_MISSION
    except StoreError as error:
        sys.stderr.write(f"{error}\n")
        return WRONG_MISSION
    except OSError as error:
        what = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"agent {mission.agent_id}: {what}{error.strerror or error}\n")
        return WRONG_MISSION


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        sys.exit(main(sys.argv[1:]))
