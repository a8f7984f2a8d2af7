"""Carry out one run with real programs in a private network. The programs are processes or containers.

A run opens the lab, starts the vehicles, the agents and the mission clock, and carries out the mission. Meanwhile it
watches all programs. At the end it exports the chains, stops the programs and closes the lab. A crash, a hang or Ctrl-C
ends the mission early. The agents that are still alive then export their chains.
"""

import asyncio
import base64
import contextlib
import os
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Self

from harness.archive.bounded_file import pack_parts
from harness.archive.directory import RunDirectory
from harness.archive.run_record import AgentRecord, CapturedFrames, Counters, DatagramsRead
from harness.archive.trace_files import packable_traces
from harness.errors import HarnessError, InterruptedRunError, MachineError, ScenarioError
from harness.play._radio_range import TRACK_S, RadioRange
from harness.play._vehicle_keys import KeyDirectories, key_directories
from harness.play.agent_control import AgentRefusedError, AgentStatus
from harness.play.hosts._agent_hosts import AgentHosts
from harness.play.mission import RunOutcome, SoughtRun
from harness.play.process._agent_process import AgentProcess
from harness.play.process._channel_process import ChannelProcess
from harness.play.process._fleet import Fleet
from harness.play.process._rogue_process import RogueProcess
from harness.play.process._run_lab import MissionLab, OpenLab, VehicleLab
from harness.play.process._watchers import MissionTasks, open_unless_interrupted
from harness.play.process.lag_meter import LagMeter
from harness.play.process.process_preflight import add_rogue_listener
from harness.play.progress import ProgressDisplay, SwarmSnapshot
from harness.play.remote._remote_agents import RemoteAgents
from harness.scenario import Scenario
from harness.scenario.changes import Change, NetworkChange, TimedInjection, describe, silent_injections
from harness.scenario.fates import Fate
from harness.scenario.faults import Fault
from netem.capture import LiveCapture
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions
from netem.errors import LabUnavailable, LiveCaptureError, NetemError
from netem.lab import UdpCounters
from sitl.circumstances import SimulatedFailure
from sitl.vehicle import VehicleKind
from ucp.clock import MICROSECONDS, MissionClock

POLL_S = 0.25
QUIET_POLL_S = 0.1
PACK_S = 1.0
"""Seconds of wall time between two searches for finished parts of traces, which the harness then compresses."""
STARTS_PER_CORE = 8
"""Maximum number of programs per processor core that start at the same time. If all programs of a large swarm started
at once, each program would need too long until its first answer.
"""
START_DELAY_S = 0.05
MIN_FOLLOW_S = 0.1
"""Minimum seconds of wall time between two reads of the vehicles' positions."""


class ProgramRun:
    """One run with real programs. It implements the interfaces `Swarm` and `AgentOperations`, and can be opened
    once.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        kinds: Mapping[int, VehicleKind],
        initial_data: bytes,
        rundir: RunDirectory,
        progress: ProgressDisplay,
        interrupted: asyncio.Event,
        *,
        agent_commands: Mapping[int, Sequence[str]],
        open_lab: OpenLab,
        keeps_disks: bool,
        hosts: AgentHosts | None = None,
    ) -> None:
        """Prepare the run. Nothing is started yet.

        - `kinds`: kind of each vehicle. Empty: a run without vehicles.
        - `interrupted`: ends the mission early when it is set.
        - `agent_commands`: command of each agent, without the mission file.
        - `open_lab`: opens a lab of processes or of containers.
        - `keeps_disks`: each agent has a disk with which it can reboot. Otherwise only agents that the scenario reboots
          with their disk have a disk.
        - `hosts`: runs all agents and vehicles on other computers. By default, they run in the lab.
        """
        self.scenario = scenario
        self.seed = seed
        self.initial_data = initial_data
        self.rundir = rundir
        self.progress = progress
        self.interrupted = interrupted
        self.played = RunOutcome()
        self._open_lab = open_lab
        self._kinds = kinds
        self._keeps_disks = keeps_disks
        self._rogue = RogueProcess(scenario.rogue, scenario, seed, rundir) if scenario.rogue else None
        self._channel = ChannelProcess(scenario, seed, rundir) if scenario.network.channel else None
        self.stage = "building the lab"
        self.network = describe(NetworkConditions())
        self.clock = MissionClock(scenario.speedup)
        self._hosts = hosts
        self._start_limit = asyncio.Semaphore(STARTS_PER_CORE * (os.cpu_count() or 1))
        self._remote = RemoteAgents(scenario, rundir, self.clock.now, hosts)
        self.agents = [
            AgentProcess(agent_id, rundir, agent_commands[agent_id], self.clock.now)
            if agent_id not in self._remote
            else self._remote_agent(agent_id)
            for agent_id in scenario.roster
        ]
        self._keys: KeyDirectories
        self._capture: LiveCapture | None = None
        self._reach = RadioRange(scenario)
        self._changing_network = asyncio.Lock()
        self._watchers = MissionTasks()
        lost_worker = hosts.lost_worker if hosts else None
        self._fleet = Fleet(scenario, kinds, rundir, self.clock, self._watchers, lost_worker)
        self._lag: LagMeter | None = None
        self._udp_before_start: Mapping[int, UdpCounters] = {}
        self._injected: list[TimedInjection] = []
        """The injections that were requested from the rogue node."""
        self._waited_until_s = 0.0
        """Mission second at which the last `until` or `until_run` ended."""
        self._starting: dict[int, asyncio.Task[None]] = {}
        """The task that restarts each agent, by agent ID. The task may still be running."""

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[Self]:
        """Open the virtual network for the context, and end the run at the end of the context.

        Raises HarnessError if the lab cannot be opened. Later errors are recorded in `played`.
        """
        with key_directories(self.scenario) as self._keys:
            self.rundir.keys = self._keys.directories
            if (keys := self._keys.keys) is not None:
                self.rundir.write_public_keys(keys.public)
                self.initial_data = keys.add_depot_key(self.initial_data)
            async with self._remote.opened():
                await open_unless_interrupted(self._remote.wait(self._show), self.interrupted)
                async with self._in_lab():
                    yield self

    @asynccontextmanager
    async def _in_lab(self) -> AsyncIterator[None]:
        try:
            lab = await open_unless_interrupted(
                self._open_lab(self.scenario, self.rundir, self._show), self.interrupted
            )
        except HarnessError:
            raise
        except LabUnavailable as error:
            raise MachineError(str(error)) from None
        except NetemError as error:
            raise MachineError(f"the lab could not be built: {error}; see {self.rundir.lab_log}") from None
        async with lab:
            self._lab = lab
            self.played.engine = lab.engine
            try:
                async with self._watchers.guard(self._watch_for_interruption(), lab.watch()):
                    yield
            except HarnessError as error:
                self._end_early(error)
            except LiveCaptureError as error:
                self._end_early(MachineError(str(error)))
            except NetemError as error:
                self._end_early(MachineError(f"the lab failed: {error}"))
            except OSError as error:
                self._end_early(MachineError(f"{error.strerror}: {error.filename or self.rundir.path}"))
            await self._end_run(lab)

    @property
    def _vehicle_lab(self) -> VehicleLab:
        return self._lab if self._hosts is None else self._hosts

    async def _watch_for_interruption(self) -> None:
        await self.interrupted.wait()
        raise InterruptedRunError(f"the run was interrupted at mission second {self.clock.now():.0f}")

    # The methods of harness.play.mission.Swarm

    def now(self) -> float:
        return self.clock.now()

    def enter(self, stage: str) -> None:
        self.stage = stage

    async def begin(self, first: Change) -> None:
        self._watchers.start(self._remote.watch_hosts(), of="hosts")
        limit = self._start_limit if self._hosts is None else contextlib.nullcontext()
        await self._fleet.start(self._vehicle_lab, limit, self._show)
        await self._start_agents(self._lab)
        if self._channel is not None:
            await self._channel.start(self._lab.network)
            self._watchers.start(self._channel.watch())
        await self.apply(first)
        self._remote.when_cut_off = self._start_cut_off
        if self.scenario.capture:
            self._capture = await LiveCapture.start(self._lab.network, self.rundir.capture(), self.scenario.roster)
            self._watchers.start(self._capture.watch())
        await self._start_clock()
        self._watchers.stop("hosts")
        self._watchers.start(self._poll_agents())
        self._watchers.start(self._pack_traces())
        self._watchers.start(self._log_script(), of="script")
        if self._fleet:
            self._watchers.start(self._follow_flight())
            self._fleet.take_off()

    async def _log_script(self) -> None:
        """Let each running agent log its scripted events at the scripted times."""
        for event in sorted(self.scenario.events.script, key=lambda event: event.at_s):
            await self.until(event.at_s)
            agent = self._agent(event.agent)
            if agent.awake:
                data = base64.b64encode(event.event_data).decode("ascii")
                try:
                    await agent.ask("log", event_id=event.event_id, data=data)
                except AgentRefusedError as error:
                    raise AgentRefusedError(
                        f"{error}; scripted events need that command (ucp/contract/CONTRACT.md)"
                    ) from None

    async def _start_agents(self, lab: MissionLab) -> None:
        self._show("starting agents")

        async def start(agent: AgentProcess) -> None:
            async with contextlib.nullcontext() if agent.agent_id in self._remote else self._start_limit:
                await self._start_agent(agent, lab)

        await asyncio.gather(*map(start, self.agents))
        if self._rogue is not None:
            await self._rogue.start(lab.network)
            self._watchers.start(self._rogue.watch(), of="rogue")

    async def _start_agent(self, agent: AgentProcess, lab: MissionLab) -> None:
        """Start the agent. If the mission has already begun, the agent joins it."""
        with_vehicle = bool(self._fleet)
        keeps_disk = self._keeps_disks or agent.agent_id in self.scenario.with_disk()
        epoch_us = self.clock.epoch_us
        await agent.start(
            lab, self.scenario, self.seed, self.initial_data, with_vehicle, keeps_disk, epoch_us, self._keys
        )
        self._watchers.start(agent.watch(), of=f"agent {agent.agent_id}")

    async def _start_clock(self) -> None:
        epoch_us = round((time.time() + START_DELAY_S) * MICROSECONDS)
        if self._capture:
            await self._capture.begin(epoch_us, self.scenario.speedup)
        if self._channel is not None:
            await self._channel.begin(epoch_us, self._fleet.places())
        await asyncio.gather(*(agent.ask("start", epoch_us=epoch_us) for agent in self.agents))
        if self._rogue is not None:
            captured = self.scenario.security.captured if self.scenario.security else None
            bundle = None if captured is None else self._keys.write_bundle(captured, kept=True)
            await self._rogue.begin(epoch_us, bundle)
        self.clock.start(epoch_us)
        self._remote.measure_lag()
        self._udp_before_start = await self._lab.network.datagrams()
        local = [agent_id for agent_id in self.scenario.roster if agent_id not in self._remote]
        namespaces = {agent_id: self._lab.network.networks[agent_id] for agent_id in local}
        self._lag = await LagMeter.start(self.rundir.lag, epoch_us, self.scenario.speedup, namespaces)

    async def apply(self, change: Change) -> None:
        if isinstance(change, NetworkChange):
            await self._apply_conditions(self._reach.change_timeline(change), asked=change.conditions)
            return
        if isinstance(change, TimedInjection):
            if self._rogue is None:
                raise ScenarioError(
                    f"`{change.what}` needs a rogue node; a run with real processes has one only if the timeline of "
                    "its scenario injects something: use --backend sim"
                )
            self._injected.append(change)
            self.played.record(change.to_json(round(max(change.at_s, self.clock.now()), 3)))
            await self._rogue.inject(change)
            return
        await self._strike_all(change)
        record = change.to_json(round(max(change.at_s, self.clock.now()), 3))
        self.played.record(record)
        self.rundir.append_network(record)

    async def _strike_all(self, fault: Fault) -> None:
        """Apply the fault at the same time to all agents that it names. If the fault is impossible for some of these
        agents, record the reasons. Raises ScenarioError if it is impossible for all of them.
        """
        strikes = [self._apply_fault(fault, agent_id) for agent_id in fault.agents]
        problems = [problem for problem in await asyncio.gather(*strikes, return_exceptions=True) if problem]
        for problem in problems:
            if not isinstance(problem, ScenarioError) or len(problems) == len(strikes):
                raise problem
        self.played.unmatched_fates += map(str, problems)

    async def _apply_fault(self, fault: Fault, agent_id: int) -> None:
        if agent_id in self._starting:
            await self._starting.pop(agent_id)
        await fault.apply(self, agent_id)

    # The methods of harness.scenario.faults.AgentOperations

    async def end_incarnation(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        shot_down = [self._fleet.shoot_down(agent_id)] if with_vehicle else []
        await asyncio.gather(self._kill(self._agent(agent_id), disk_kept=disk_kept), *shot_down)

    async def begin_incarnation(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        agent = self._agent(agent_id)
        start = self._restart_with_vehicle(agent) if new_vehicle else self._start_agent(agent, self._lab)
        self._starting[agent_id] = self._watchers.create_task(start)

    async def fall(self, agent_id: int) -> None:
        self._fleet.fall(agent_id)

    async def pause(self, agent_id: int) -> None:
        await self._agent(agent_id).pause()

    async def resume(self, agent_id: int) -> None:
        await self._agent(agent_id).resume()

    async def stop_logging(self, agent_id: int) -> None:
        await self._agent(agent_id).ask("stop_events")

    async def switch_off(self, agent_id: int) -> None:
        self._watchers.stop(f"agent {agent_id}")
        await asyncio.gather(self._agent(agent_id).switch_off(), self._fleet.shoot_down(agent_id))

    async def revoke(self, agent_id: int, heard_by: Sequence[int]) -> None:
        assert self._keys.keys is not None, "`refuse_revocations` comes first"
        revocation = base64.b64encode(self._keys.keys.revoke(agent_id)).decode("ascii")
        hearers = [agent for agent in self.agents if agent.agent_id in heard_by and agent.awake]
        await asyncio.gather(*(agent.ask("revoke", revocation=revocation) for agent in hearers))

    async def set_circumstance(
        self, agent_id: int, what: str, circumstance: SimulatedFailure, *, by_hand: bool
    ) -> None:
        if not self._fleet:
            raise ScenarioError(f"`{what}` needs vehicles, but this run has none")
        at_s = round(self.clock.now(), 3)
        if not by_hand:
            self._watchers.create_task(self._simulate_circumstance(agent_id, what, circumstance, at_s))
        elif problem := await self._fleet.simulate(agent_id, what, circumstance, at_s):
            raise ScenarioError(problem)  # the user waits for the result of an intervention

    async def _simulate_circumstance(
        self, agent_id: int, what: str, circumstance: SimulatedFailure, at_s: float
    ) -> None:
        if problem := await self._fleet.simulate(agent_id, what, circumstance, at_s):
            self.played.unmatched_fates.append(problem)

    def _agent(self, agent_id: int) -> AgentProcess:
        return self.agents[self.scenario.roster.index(agent_id)]

    async def _kill(self, agent: AgentProcess, *, disk_kept: bool = False) -> None:
        self._watchers.stop(f"agent {agent.agent_id}")
        await agent.kill(disk_kept=disk_kept)

    async def _restart_with_vehicle(self, agent: AgentProcess) -> None:
        """Start a new vehicle program in place of the lost vehicle, and a new agent program on the new vehicle."""
        await self._fleet.replace(agent.agent_id, self._vehicle_lab, incarnation=agent.incarnations + 1)
        await self._start_agent(agent, self._lab)

    async def _apply_conditions(self, change: NetworkChange, asked: NetworkConditions | None = None) -> None:
        """Apply and record the network conditions of a change.

        For a change that the timeline requests, `asked` contains the requested conditions, and the record contains both
        the requested and the applied conditions. For a change that the movement of vehicles causes, the record contains
        only the change.
        """
        async with self._changing_network:  # apply changes in the order of their requests
            conditions = add_rogue_listener(change.conditions, self.scenario)
            applied = await self._lab.apply(self._remote.compensated(conditions.at_speed(self.scenario.speedup)))
            if self._channel is not None:
                await (self._channel.clear() if change.clears_all else self._channel.apply(change.conditions))
        self.network = change.detail
        record = change.to_json(round(max(change.at_s, self.clock.now()), 3))
        self.played.record(record)
        if asked is not None:
            record |= {"asked": asked.to_json(), "applied": self._without_rogue(applied)}
        self.rundir.append_network(record)

    def _remote_agent(self, agent_id: int) -> AgentProcess:
        controlled = partial(self._remote.program, agent_id)
        command = self._remote.stand_in_command(agent_id)
        loss = partial(self._remote.loss, agent_id)
        return AgentProcess(agent_id, self.rundir, command, self.clock.now, controlled=controlled, loss=loss)

    def _start_cut_off(self) -> None:
        with contextlib.suppress(RuntimeError):  # a failure is already ending the mission
            self._watchers.start(self._cut_off())

    async def _cut_off(self) -> None:
        """Disconnect the vehicles of remote agents whose connections are lost. Reconnect a vehicle after the connection
        of its agent is restored.
        """
        await self._apply_conditions(self._reach.cut_off(self.clock.now(), self._remote.cut_off))

    def _without_rogue(self, applied: AppliedConditions) -> dict[str, Any]:
        """Return the network conditions and packet counters as JSON, without the links of the rogue node."""
        figures = applied.to_json()
        if self._rogue is not None:
            figures["receivers"].pop(str(self._rogue.vehicle), None)
        return figures

    async def _follow_flight(self) -> None:
        """Record the positions of the vehicles, and update the radio losses for these positions."""
        radio = self.scenario.network.radio
        every_s = max(MIN_FOLLOW_S, self.clock.wall_s(radio.update_s if radio else TRACK_S))
        while True:
            places = self._fleet.places()
            self.rundir.append_tracks(self.clock.now(), places)
            if change := self._reach.move(self.clock.now(), places):
                await self._apply_conditions(change)
            if self._channel is not None:
                await self._channel.move(places)
            await asyncio.sleep(every_s)

    async def until(self, mission_s: float) -> None:
        while (left_s := mission_s - self.clock.now()) > 0:  # the clock is 0 until the mission starts
            await asyncio.sleep(self.clock.wall_s(left_s))
            self._waited_until_s = self.clock.now()

    async def until_run(self, sought: SoughtRun, mission_s: float) -> int | None:
        while True:
            over = self.clock.now() >= mission_s
            for agent in self.agents:
                for run in agent.handler_runs_since(self._waited_until_s, sought.handler):
                    if sought.matches(agent.agent_id, run):
                        self._waited_until_s = run.t
                        return agent.agent_id
            if over:
                self._waited_until_s = self.clock.now()
                return None
            await asyncio.sleep(QUIET_POLL_S)

    async def hold(self, fate: Fate) -> int:
        raise ScenarioError("`hold` needs virtual time: use --backend sim")

    async def release(self, number: int, fate: Fate) -> None:
        raise AssertionError("no message was held")

    async def stop_events(self) -> None:
        self._watchers.stop("script")
        await asyncio.gather(*self._starting.values())
        await asyncio.gather(*(agent.ask("stop_events") for agent in self.agents if agent.awake))

    async def until_idle(self, limit_s: float) -> bool:
        deadline_s = self.clock.now() + limit_s
        handled: list[int] | None = None
        while self.clock.now() < deadline_s:
            statuses = (await self._statuses()).values()
            before, handled = handled, [status.handled for status in statuses]
            if all(status.idle for status in statuses) and handled == before:
                return not any(agent.outcome == "paused" for agent in self.agents)
            await asyncio.sleep(QUIET_POLL_S)
        return False

    async def keep_chains(self) -> None:
        await asyncio.gather(*(agent.export() for agent in self._reachable_agents()))
        self.rundir.keep_exports_before_final_reconcile()

    async def reconcile(self, agent_id: int) -> None:
        await self._agent(agent_id).ask("reconcile")

    async def top_chain_hashes(self) -> dict[int, str]:
        return {agent_id: status.top_chain_hash for agent_id, status in (await self._statuses()).items()}

    async def completed(self) -> dict[int, int]:
        return {agent_id: status.completed for agent_id, status in (await self._statuses()).items()}

    async def snapshot(self) -> RunOutcome:
        await asyncio.gather(*(agent.export() for agent in self._reachable_agents()))
        for agent in self.agents:
            agent.collect_files()
        agents, remote = self._agent_records(), self._remote.records()
        channel = await self._channel.totals() if self._channel is not None else None
        mission_s = round(self.clock.now(), 1)
        return replace(self.played, mission_s=mission_s, agents=agents, channel=channel, remote=remote)

    def _reachable_agents(self) -> list[AgentProcess]:
        """Return the agents that are reachable: not dead and not paused. A remote agent is not reachable if the
        connection to its computer is lost.
        """
        return [agent for agent in self.agents if agent.awake and agent.agent_id not in self._remote.cut_off]

    async def _statuses(self) -> dict[int, AgentStatus]:
        """Return the status of each reachable agent (see `_reachable_agents`)."""
        agents = [agent for agent in self.agents if agent.agent_id not in self._remote.cut_off]
        polled = await asyncio.gather(*(agent.poll() for agent in agents))
        return {agent.agent_id: status for agent, status in zip(agents, polled, strict=True) if status}

    async def _poll_agents(self) -> None:
        while True:
            await self._statuses()
            self._show(self.stage)
            await asyncio.sleep(POLL_S)

    async def _pack_traces(self) -> None:
        """Compress finished parts of large traces, so that the run needs less disk space."""
        while True:
            await asyncio.sleep(PACK_S)
            with contextlib.suppress(OSError):  # the disk is full, and the agents record it
                for path in packable_traces(self.rundir.agents):
                    await asyncio.to_thread(pack_parts, path)

    # End of the run

    def _end_early(self, error: HarnessError) -> None:
        self.played.end_early("interrupted" if isinstance(error, InterruptedRunError) else "failed", error)

    async def _end_run(self, lab: MissionLab) -> None:
        """Export the chains of the living agents, stop all programs, and close the network. Record errors of
        programs.
        """
        self._show("exporting")
        self.played.mission_s = round(self.clock.now(), 1)
        await self._remote.end()
        if self._lag is not None:
            await self._lag.stop()
        exported = await asyncio.gather(*(agent.export_at_end() for agent in self.agents), return_exceptions=True)
        for error in exported:
            if error is not None and not isinstance(error, HarnessError):
                raise error
            if error is not None and self.played.outcome == "completed":
                self._end_early(error)
        self.played.vehicles = self._fleet.to_json()
        if self.played.outcome == "completed":
            self.played.unmatched_fates += self._fleet.shortfalls(self.played.mission_s)
        self.played.ground_station = self._fleet.close_station()
        try:
            if self._rogue is not None:
                await self._stop_rogue(self._rogue)
            counters = self._without_rogue(await lab.read())
            self.played.counters = Counters.model_validate(counters)
            self.rundir.append_network({"at_s": self.played.mission_s, "what": "end", "counters": counters})
            await asyncio.gather(*(agent.stop() for agent in self.agents), self._fleet.stop())
            self.played.datagrams = self._datagram_counters(await lab.network.datagrams())
            await self._end_channel()
            for agent in self.agents:
                agent.collect_files()
        except NetemError as error:  # the loss of the lab explains the crashes
            self._end_early(MachineError(str(error)))
        except OSError as error:
            self._end_early(MachineError(f"{error.strerror}: {error.filename or self.rundir.path}"))
        await self._end_capture()
        try:
            await lab.close()
        except NetemError as error:
            self._end_early(MachineError(str(error)))
        self.played.agents, self.played.remote = self._agent_records(), self._remote.records()

    def _agent_records(self) -> dict[str, AgentRecord]:
        """Return the record of each agent. For a remote agent, the record contains the command on its own computer."""
        records = {str(agent.agent_id): agent.record() for agent in self.agents}
        for agent_id, remote in self._remote.records().items():
            records[agent_id].command = remote.command
        return records

    def _datagram_counters(self, counted: Mapping[int, UdpCounters]) -> dict[str, DatagramsRead]:
        """Return the datagram counters of the agents for run.json. Omit agents whose vehicle program also uses UDP,
        because these counters would also count the datagrams of the vehicle program. Omit agents that were cut off from
        their stand-ins, too.
        """
        agents = [
            agent
            for agent in self._udp_before_start
            if agent in self.scenario.roster and not self._remote.was_cut_off(agent)
        ]
        return {
            str(agent): DatagramsRead(
                read=counted[agent].read,
                before_start=self._udp_before_start[agent].read,
                overflowed=counted[agent].overflowed,
                unreachable=counted[agent].unreachable,
                others=counted[agent].others,
                broadcasts=counted[agent].broadcasts,
            )
            for agent in agents
            if agent not in self._kinds or not self._kinds[agent].uses_udp
        }

    async def _end_channel(self) -> None:
        if self._channel is None:
            return
        try:
            await self._channel.clear()
            self.played.channel = await self._channel.totals()
        except MachineError as error:
            if self.played.outcome == "completed":
                self._end_early(error)
        await self._channel.stop()

    async def _end_capture(self) -> None:
        if self._capture is None:
            return
        try:
            counted = await self._capture.stop()
        except LiveCaptureError as error:
            if self.played.outcome == "completed":
                self._end_early(MachineError(str(error)))
            return
        self.played.capture = {
            str(vehicle): CapturedFrames.model_validate(frames) for vehicle, frames in counted.items()
        }

    async def _stop_rogue(self, rogue: RogueProcess) -> None:
        try:
            await rogue.stop()
        except MachineError as error:
            if self.played.outcome == "completed":
                self._end_early(error)
        self.played.unmatched_fates += silent_injections(self._injected, rogue.sent)

    def _show(self, stage: str) -> None:
        self.stage = stage
        self.progress.show(
            SwarmSnapshot(
                stage,
                self.clock.now(),
                self.scenario.duration_s,
                self.network,
                {agent.agent_id: agent.status for agent in self.agents},
            )
        )
