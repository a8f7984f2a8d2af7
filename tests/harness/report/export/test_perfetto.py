"""Test `ucp-harness export --perfetto` by reading the file with Perfetto's own format definition."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent

from harness.archive.archive import RunArchive
from harness.archive.history import history_of
from tests.harness.command import harness

Track = tuple[str, str]


class ParsedTrace:
    """A trace that was read: its tracks as pairs (group, name), and the events of each track in Perfetto's order."""

    def __init__(self, file: Path) -> None:
        trace = Trace()
        trace.ParseFromString(file.read_bytes())
        self.tracks: dict[int, Track] = {}
        self.events: list[tuple[Track, int, Any]] = []
        for packet in trace.packet:
            assert packet.trusted_packet_sequence_id
            if packet.HasField("track_descriptor"):
                described = packet.track_descriptor
                assert described.uuid not in self.tracks
                group = self.tracks[described.parent_uuid][0] if described.parent_uuid else described.name
                self.tracks[described.uuid] = group, described.name
            elif packet.HasField("track_event"):  # of a track that was described before
                track = self.tracks[packet.track_event.track_uuid]
                self.events.append((track, packet.timestamp, packet.track_event))
        self.events.sort(key=lambda event: event[1])

    def on(self, group: str, name: str) -> list[tuple[int, Any]]:
        return [(at_ns, event) for track, at_ns, event in self.events if track == (group, name)]


@pytest.fixture(scope="module")
def trace(run: Path, tmp_path_factory: pytest.TempPathFactory) -> ParsedTrace:
    file = tmp_path_factory.mktemp("perfetto") / "run.pftrace"
    exported = harness("export", run, "--perfetto", file)
    assert (exported.returncode, exported.stderr) == (0, "")
    return ParsedTrace(file)


def test_every_handler_run_is_on_its_agents_track(run: Path, trace: ParsedTrace) -> None:
    for agent, traced in RunArchive(run).traces.items():
        shown = [(at_ns, event.name) for at_ns, event in trace.on(f"agent {agent}", "handlers")]
        assert shown == [(round(step.t * 1e9), step.handler) for step in traced.runs]


def test_arrow_leads_from_sending_run_to_each_receiving_run(run: Path, trace: ParsedTrace) -> None:
    starts: dict[int, str] = {}
    arrows: Counter[tuple[str, str]] = Counter()
    for (group, _), _, event in trace.events:
        for number in event.flow_ids:
            assert number not in starts
            starts[number] = group
        for number in event.terminating_flow_ids:
            arrows[starts.pop(number), group] += 1
    assert not starts
    archive = RunArchive(run)
    messages = history_of(archive.traces, [], 1e6).messages or []
    assert arrows == Counter(
        (f"agent {message.sender}", f"agent {agent}") for message in messages for agent, _ in message.receipts
    )
    assert arrows["agent 1", "agent 2"] > 10


def test_votes_and_reconciles_are_slices_that_nest(run: Path, trace: ParsedTrace) -> None:
    names = set()
    for track in trace.tracks.values():
        depth = 0
        for _, event in trace.on(*track):
            depth += {TrackEvent.TYPE_SLICE_BEGIN: 1, TrackEvent.TYPE_SLICE_END: -1}.get(event.type, 0)
            assert 0 <= depth <= (2 if track[1] == "reconciles" else 1)
            names.add(event.name)
        assert depth == 0
    assert {"phase 1", "reconcile: vote not approved"} <= names
    assert any(name.startswith("vote on 1.") for name in names)


def test_counters_show_chains_and_losses(run: Path, trace: ParsedTrace) -> None:
    chain = [event.double_counter_value for _, event in trace.on("agent 3", "chain (blocks)")]
    assert chain[-1] == len(RunArchive(run).exports.by_agent[3].chain)
    assert max(event.double_counter_value for _, event in trace.on("swarm", "connected groups")) == 2
    assert (50 * 10**9) in [at_ns for at_ns, _ in trace.on("swarm", "connected groups")]
    assert trace.on("swarm", "worst loss (%)")
    assert max(event.double_counter_value for _, event in trace.on("agent 1", "altitude (m)")) > 15
