"""Test the relay, which takes broadcasts from the virtual switch and delivers them one by one."""

from __future__ import annotations

import asyncio
import json
import os
import struct
import sys
from pathlib import Path
from typing import Any

from netem.conditions import LinkConditions, NetworkConditions
from netem.lab import Lab
from netem.relay import ReceivedBroadcast
from tests.netem.conftest import AIR, DEADLINE_S, PORT, Air

PACKETS = 60
RELAY = f"""
import json, select, signal
from netem.relay import Relay

relay = Relay([1, 2, 3], [4])
relay.open()
ended = []
signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
print("ready", flush=True)
heard = []
while not ended:
    select.select([relay.input], [], [], 0.05)
    for broadcast in relay.take():
        data = broadcast.udp_data({PORT})
        heard.append([broadcast.vehicle, None if data is None else len(data)])
        if data is not None:
            relay.deliver(3, broadcast.frame)
relay.close()
print(json.dumps(heard), flush=True)
"""


async def relayed(folder: Path, engine: str, conditions: NetworkConditions) -> dict[str, Any]:
    """Broadcast from vehicle 1 twice: while the relay is active and delivers only to vehicle 3, and then without the
    relay.

    Vehicle 4 does not belong to the relay.
    """
    async with await Lab.open([1, 2, 3, 4], engine=engine, log=folder / "lab.log") as lab:  # type: ignore[arg-type]
        await lab.apply(conditions)
        air, output = Air(lab, folder), folder / "relay.log"
        relay = await lab.spawn(
            None,
            [sys.executable, "-c", RELAY],
            cwd=folder,
            env={"PATH": os.environ["PATH"], "PYTHONPATH": str(AIR.parents[2])},
            stdout=output,
            stderr=output,
        )
        async with asyncio.timeout(DEADLINE_S):
            while "ready" not in output.read_text():
                assert relay.returncode is None, output.read_text()
                await asyncio.sleep(0.01)
        listeners = {vehicle: await air.start_ready(vehicle, "receive", PORT) for vehicle in (2, 3, 4)}
        sender = await air.start(1, "broadcast", PORT, PACKETS, 0, lab.broadcast)
        assert await asyncio.wait_for(sender.process.wait(), DEADLINE_S) == 0
        await relay.send_signal(15)
        assert await asyncio.wait_for(relay.wait(), DEADLINE_S) == 0, output.read_text()
        after = await air.start(1, "broadcast", PORT, PACKETS, PACKETS, lab.broadcast)
        assert await asyncio.wait_for(after.process.wait(), DEADLINE_S) == 0
        got = {vehicle: await listener.finish() for vehicle, listener in listeners.items()}
        return {"got": got, "heard": json.loads(output.read_text().splitlines()[-1])}


def test_relay_alone_delivers_broadcasts_while_it_is_open(engine: str, tmp_path: Path) -> None:
    found = asyncio.run(relayed(tmp_path, engine, NetworkConditions()))
    assert found["got"][3]["numbers"] == list(range(2 * PACKETS))
    assert found["got"][2]["numbers"] == list(range(PACKETS, 2 * PACKETS))
    assert found["got"][4]["numbers"] == list(range(2 * PACKETS))
    assert found["got"][3]["corrupt"] == 0
    assert found["heard"] == [[1, 12]] * PACKETS


def test_engine_passes_delivered_frames_over_any_loss_and_cut(engine: str, tmp_path: Path) -> None:
    cut = NetworkConditions(LinkConditions(loss=1.0), partition=(frozenset({1}), frozenset({2, 3})))
    found = asyncio.run(relayed(tmp_path, engine, cut))
    assert found["got"][3]["numbers"] == list(range(PACKETS))
    assert found["got"][2]["numbers"] == []


def frame(
    protocol: int = 17, fragment: int = 0x4000, port: int = PORT, kind: int = 0x800, data: bytes = b"ucp"
) -> ReceivedBroadcast:
    udp = struct.pack("!HHHH", 1, port, 8 + len(data), 0) + data
    ip = struct.pack("!BBHHHBBHII", 0x45, 0, 20 + len(udp), 0, fragment, 64, protocol, 0, 1, 2)
    return ReceivedBroadcast(1, 0, bytes(10) + b"\xff" * 6 + bytes(6) + struct.pack("!H", kind) + ip + udp + bytes(20))


def test_only_whole_udp_datagrams_to_the_port_have_data() -> None:
    assert frame().udp_data(PORT) == b"ucp"
    assert frame(data=b"").udp_data(PORT) == b""
    others = [frame(protocol=6), frame(fragment=0x2000), frame(fragment=1), frame(port=5), frame(kind=0x806)]
    assert [other.udp_data(PORT) for other in others] == [None] * 5
    short = ReceivedBroadcast(1, 0, frame().frame[:30])
    assert short.udp_data(PORT) is None
