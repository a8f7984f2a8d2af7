"""The connection to a vehicle: what it sends goes to the translator, and it is asked for what the translator wants."""

import asyncio
import contextlib
from collections.abc import Callable

_REQUESTED = {33: 1.0, 30: 1.0, 1: 2.0, 2: 2.0}
"""Message ID: interval in simulated seconds. HEARTBEAT, STATUSTEXT and MISSION_ITEM_REACHED come unasked; at an
interval ArduPilot would repeat which mission item it reached last."""
_SET_MESSAGE_INTERVAL = 511  # MAV_CMD_SET_MESSAGE_INTERVAL

_COMPANION_SYSTEM, _COMPANION_COMPONENT = 255, 191  # MAV_COMP_ID_ONBOARD_COMPUTER

_FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
_FIRST_REQUEST_S, _LAST_REQUEST_S = 1.0, 30.0


async def follow(host: str, port: int, sink: Callable[[bytes], None]) -> None:
    """Hand everything that the vehicle at `host`:`port` sends to `sink`, until cancelled.

    Waits for the vehicle to listen, asks it for the messages that `TelemetryEvents` wants, and connects again when it
    restarts. What `sink` raises ends it.
    """
    retry_s = _FIRST_RETRY_S
    while True:
        try:
            reader, writer = await asyncio.open_connection(host, port)
        except OSError:
            await asyncio.sleep(retry_s)
            retry_s = min(2 * retry_s, _LAST_RETRY_S)
            continue
        asking = asyncio.create_task(_keep_asking(writer))
        try:
            while data := await _read(reader):
                retry_s = _FIRST_RETRY_S
                sink(data)
        finally:
            asking.cancel()
            writer.close()
        await asyncio.sleep(_FIRST_RETRY_S)  # a port that accepts and closes at once is not hammered


async def _read(reader: asyncio.StreamReader) -> bytes:
    try:
        return await reader.read(65536)
    except OSError:  # a vehicle that is killed resets its connections
        return b""


async def _keep_asking(writer: asyncio.StreamWriter) -> None:
    """Ask for the messages, and again ever more seldom: a vehicle that is booting acknowledges and forgets."""
    from pymavlink.dialects.v20 import common

    mav = common.MAVLink(None, srcSystem=_COMPANION_SYSTEM, srcComponent=_COMPANION_COMPONENT)
    pause_s = _FIRST_REQUEST_S
    while True:
        for message_id, interval_s in _REQUESTED.items():
            # target 0: every system on this link, which is one
            request = common.MAVLink_command_long_message(
                0, 0, _SET_MESSAGE_INTERVAL, 0, message_id, interval_s * 1e6, 0, 0, 0, 0, 0
            )
            writer.write(request.pack(mav))
            mav.seq = (mav.seq + 1) % 256
        with contextlib.suppress(OSError):
            await writer.drain()
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, _LAST_REQUEST_S)
