"""Run agents with programming errors: `python -m tests.harness.conformance.wrong_programs MISTAKE MISSION_FILE`, or
`--virtual`.

Each agent is `python -m ucp.node` with one mistake outside the 20 algorithms. `ucp/quirks` has mistakes inside the
algorithms.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import ucp.node
import ucp.trace
from ucp import virtual
from ucp.agent import Agent
from ucp.agent_files import TraceFile
from ucp.block import Block
from ucp.events import decode_events
from ucp.node import Node

MISTAKES: dict[str, Callable[[], object]] = {}
LONG_S = 1000.0


def mistake(make: Callable[[], object]) -> Callable[[], object]:
    MISTAKES[make.__name__] = make
    return make


def _patch(owner: Any, name: str, replacement: Callable[..., Any]) -> None:
    """Replace a method. The replacement gets the original method as its first argument."""
    old = getattr(owner, name)
    setattr(owner, name, lambda *arguments, **keys: replacement(old, *arguments, **keys))


def _hang_after(limit: int) -> None:
    inputs = 0

    def count(old: Callable[..., Any], *arguments: Any) -> Any:
        nonlocal inputs
        inputs += 1
        if inputs > limit:
            time.sleep(LONG_S)
        return old(*arguments)

    _patch(Node, "_feed", count)


@mistake
def hangs_after_20_inputs() -> None:
    _hang_after(20)


@mistake
def hangs_after_500_inputs() -> None:
    _hang_after(500)


@mistake
def ends_after_50_inputs() -> None:
    lines = 0

    def count(old: Callable[..., Any], *arguments: Any) -> Any:
        nonlocal lines
        lines += 1
        if lines > 50:
            sys.exit(3)
        return old(*arguments)

    _patch(Node, "_feed", count)
    _patch(virtual.VirtualAgent, "give", count)


# Records


def _change_lines(change: Callable[[list[str]], list[str]]) -> None:
    def write(old: Callable[..., Any], self: TraceFile, text: str) -> None:
        old(self, "".join(change(text.splitlines(keepends=True))))

    _patch(TraceFile, "write", write)


def _change_objects(change: Callable[[dict[str, Any]], None]) -> None:
    def changed(lines: list[str]) -> list[str]:
        objects = [json.loads(line) for line in lines]
        for line in objects:
            change(line)
        return [json.dumps(line) + "\n" for line in objects]

    _change_lines(changed)


@mistake
def omits_commits_from_trace() -> None:
    _change_lines(lambda lines: [line for line in lines if '"chain+"' not in line])


@mistake
def omits_drops_from_trace() -> None:
    _change_lines(lambda lines: [line for line in lines if '"dropped"' not in line])


@mistake
def omits_commands_from_trace() -> None:
    _change_lines(lambda lines: [line for line in lines if '"command"' not in line])


@mistake
def writes_lines_of_an_input_backwards() -> None:
    _change_lines(lambda lines: lines[::-1])


@mistake
def writes_wall_seconds_into_trace() -> None:
    def change(line: dict[str, Any]) -> None:
        if "t" in line:
            line["t"] = round(line["t"] / 20.0, 6)

    _change_objects(change)


@mistake
def names_every_drop_truncated() -> None:
    def change(line: dict[str, Any]) -> None:
        if "dropped" in line:
            line["dropped"] = "truncated"

    _change_objects(change)


@mistake
def leaves_settings_out_of_header() -> None:
    def change(line: dict[str, Any]) -> None:
        if "schema" in line:
            line["settings"] = {}

    _change_objects(change)


@mistake
def writes_only_itself_as_roster() -> None:
    def change(line: dict[str, Any]) -> None:
        if "schema" in line:
            line["roster"] = [line["agent_id"]]

    _change_objects(change)


@mistake
def keeps_trace_in_memory() -> None:
    """Keep the trace in memory, so that a killed agent has no trace."""
    kept: list[str] = []
    _patch(TraceFile, "write", lambda old, self, text: kept.append(text))

    def close(old: Callable[..., Any], self: TraceFile) -> None:
        self._file.write("".join(kept).encode())
        old(self)

    _patch(TraceFile, "close", close)


@mistake
def stamps_block_with_first_event() -> None:
    from ucp import commit

    def first(old: type[Block], agent_id: int, timestamp_us: int, event_data: bytes) -> Block:
        return old(agent_id, decode_events(event_data)[0].timestamp_us, event_data)

    _patch(commit, "Block", first)


def _change_export(change: Callable[[dict[str, Any]], None]) -> None:
    def write(old: Callable[..., Any], path: Path, document: dict[str, Any]) -> None:
        change(document)
        old(path, document)

    _patch(ucp.node, "write_json_atomically", write)


@mistake
def exports_no_completed_blocks() -> None:
    _change_export(lambda export: export.update(completed=[]))


@mistake
def exports_at_wrong_time() -> None:
    _change_export(lambda export: export.update(exported_at_us=export["exported_at_us"] // 1000))


@mistake
def forgets_current_block_in_export() -> None:
    _change_export(lambda export: export["current_block"].update(event_data=""))


# Counters


@mistake
def counts_too_few_bytes() -> None:
    _patch(Node, "_status", lambda old, *arguments: {**old(*arguments), "bytes_sent": 7})


@mistake
def counts_drops_as_handled() -> None:
    def status(old: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        report = old(*arguments)
        return {**report, "handled": report["handled"] + sum(report["dropped"].values()), "dropped": {}}

    _patch(Node, "_status", status)


# Network


@mistake
def sends_each_datagram_twice() -> None:
    _patch(Agent, "datagrams_to_send", lambda old, self: [each for each in old(self) for _ in range(2)])


@mistake
def repeats_sequence_number() -> None:
    def sent(old: Callable[..., Any], self: Agent) -> list[bytes]:
        return [data[:8] + bytes(4) + data[12:] for data in old(self)]

    _patch(Agent, "datagrams_to_send", sent)


@mistake
def sends_as_another_agent() -> None:
    def sent(old: Callable[..., Any], self: Agent) -> list[bytes]:
        return [data[:4] + (2).to_bytes(4, "big") + data[8:] for data in old(self)]

    _patch(Agent, "datagrams_to_send", sent)


@mistake
def answers_its_own_echo() -> None:
    """Count each of the agent's own broadcasts as dropped."""

    def receive(old: Callable[..., Any], self: Node) -> None:
        while True:
            try:
                data, _ = self._socket.recvfrom(65536)
            except OSError:
                return
            if self.clock.running:
                self._feed(partial(self.agent.receive_datagram, data))

    _patch(Node, "_receive", receive)


@mistake
def receives_only_1500_bytes() -> None:
    ucp.node.MAX_READ_BYTES = 1472


# Program


@mistake
def leaves_children() -> None:
    subprocess.Popen(["sleep", "1000"], start_new_session=True, stdin=subprocess.DEVNULL)


@mistake
def leaks_descriptors() -> None:
    def drive(old: Callable[..., Any], *arguments: Any) -> None:
        os.open("/dev/null", os.O_RDONLY)
        old(*arguments)

    _patch(Node, "_feed", drive)


@mistake
def logs_after_stop_events() -> None:
    _patch(Node, "_stop_source", lambda old, self: None)


@mistake
def logs_random_events_without_source() -> None:
    def begin(old: Callable[..., Any], self: Node, *arguments: Any) -> None:
        old(self, *arguments)
        self._loop.call_later(0.2, lambda: self.log_event(1, bytes(200)))

    _patch(Node, "_begin", begin)


@mistake
def sends_after_sigterm() -> None:
    def run(old: Callable[..., Any], self: Node) -> int:
        def stop(stop_loop: Callable[..., Any]) -> None:
            self._feed(self.agent.begin_reconcile)
            stop_loop()

        _patch(self._loop, "stop", stop)
        status: int = old(self)
        return status

    _patch(Node, "run", run)


@mistake
def ends_with_status_3() -> None:
    _patch(Node, "run", lambda old, self: (old(self), 3)[1])


@mistake
def dies_of_a_second_sigterm() -> None:
    def run(old: Callable[..., Any], self: Node) -> int:
        def stop(stop_loop: Callable[..., Any]) -> None:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            time.sleep(1)
            stop_loop()

        _patch(self._loop, "stop", stop)
        status: int = old(self)
        return status

    _patch(Node, "run", run)


@mistake
def ends_with_status_3_without_a_mission() -> None:
    """The agent ends with status 3 at a signal before the command `start`. In virtual time, it does so at the end of
    its input.
    """

    def run(old: Callable[..., Any], self: Node) -> int:
        status: int = old(self)
        return status if self.clock.running else 3

    _patch(Node, "run", run)
    _patch(virtual, "main", lambda old: old() or 3)


@mistake
def needs_20_s_to_end() -> None:
    def export(old: Callable[..., Any], self: Node) -> int:
        status: int = old(self)
        time.sleep(20)
        return status

    _patch(Node, "run", export)


@mistake
def ignores_requested_quirks() -> None:
    _patch(Node, "_apply_quirks", lambda old, self: None)
    _patch(virtual.VirtualAgent, "_apply_quirks", lambda old, self: None)


@mistake
def ignores_reconcile() -> None:
    _patch(Node, "_reconcile", lambda old, self, request: {})


@mistake
def leaves_other_files() -> None:
    Path("scratch.tmp").write_text("something")


@mistake
def writes_export_in_place() -> None:
    def write(old: Callable[..., Any], path: Path, document: dict[str, Any]) -> None:
        path.write_text(json.dumps(document))

    _patch(ucp.node, "write_json_atomically", write)


@mistake
def reads_times_as_doubles() -> None:
    def start(old: Callable[..., Any], self: Node, request: dict[str, Any]) -> Any:
        return old(self, {**request, "epoch_us": int(float(request["epoch_us"]) // 1024 * 1024)})

    _patch(Node, "_start", start)


@mistake
def answers_requests_only_one_by_one() -> None:
    """Lose a request that arrives together with another request."""
    from ucp.control import _ControlClient

    def go_on(old: Callable[..., Any], self: Any) -> None:
        line, newline, _ = self._received.partition(b"\n")
        if newline:
            self._received = line + newline
        old(self)

    _patch(_ControlClient, "_answer_next_line", go_on)


def main(arguments: Sequence[str]) -> int:
    name, *others = arguments
    MISTAKES[name]()
    return ucp.node.main(others)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
