"""A UCP agent as a ROS 2 node: python ucp_node.py MISSION_FILE (docs/how-to/run-a-ros-node.md).

The node runs the harness's own agent in the main loop of rclpy. A ROS executor and ROS timers call the agent. It
receives its events as ROS messages. The datagrams of UCP stay UDP broadcasts to other vehicles, and ROS messages stay
on this vehicle.

    ~/event   in   std_msgs/UInt8MultiArray   an event to log: its ID (1..254), then its data
    ~/status  out  std_msgs/String            the answer of the control socket to `status`, in JSON, every second
    ~/chain   out  std_msgs/String            the chain export in JSON, at each change of the top block

The node of agent 7 is /ucp/agent_7. A later subscriber also receives the last message of `status` and of `chain`.
"""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Semaphore, Thread
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node as RosNode
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String, UInt8MultiArray

from ucp.export import export_chain
from ucp.loop import Callback, Loop, ScheduledCall
from ucp.mission import Mission
from ucp.node import Node, main

STATUS_PERIOD_S = 1.0
KEEP_LAST = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

THIS_VEHICLE_ONLY = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "ROS_STATIC_PEERS": "",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}
"""Environment variables that limit ROS to loopback.

They also switch off shared memory, which all vehicles on one machine would share. Vehicles then communicate only
through UCP.
"""

NO_LOG_FILES = ["--ros-args", "--disable-external-lib-logs"]
"""Arguments that make ROS write no log files. In a container, an agent can write only next to its mission file."""


class RosLoop(Loop):
    """An event loop with the interface of `ucp.loop` on a ROS executor. One ROS timer is set to the next callback.

    ROS cannot wait for sockets. A thread therefore waits for them, and wakes the executor, which then calls the
    functions of the sockets.
    """

    def __init__(self, ros: RosNode) -> None:
        super().__init__()
        self._ros = ros
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(ros)
        self._timer = ros.create_timer(STATUS_PERIOD_S, self._call_and_reset_timer, autostart=False)
        self._wake_up = ros.create_guard_condition(self._call_back_ready_sockets)
        self._ready: list[Any] = []
        self._called_back = Semaphore(0)
        Thread(target=self._wait_for_sockets, daemon=True).start()

    def call_later(self, delay_s: float, callback: Callback) -> ScheduledCall:
        timer = super().call_later(delay_s, callback)
        self._set_timer()
        return timer

    def run(self) -> None:
        while self._running:
            self._executor.spin_once()
        self._running = True

    def _set_timer(self) -> None:
        """Set the ROS timer to the time of the next callback."""
        delay_s = self._seconds_to_next_timer()
        if delay_s is None:
            self._timer.cancel()
        else:
            self._timer.timer_period_ns = round(delay_s * 1e9)
            self._timer.reset()

    def _call_and_reset_timer(self) -> None:
        self._call_due_timers()
        self._set_timer()

    def _wait_for_sockets(self) -> None:
        while True:
            self._ready = self._selector.select()
            self._wake_up.trigger()
            self._called_back.acquire()

    def _call_back_ready_sockets(self) -> None:
        self._call_back(self._ready)
        self._called_back.release()


class RosAgent(Node):
    def __init__(self, mission: Mission, directory: Path) -> None:
        self._ros = rclpy.create_node(f"agent_{mission.agent_id}", namespace="ucp")
        self._status_out = self._ros.create_publisher(String, "~/status", KEEP_LAST)
        self._chain_out = self._ros.create_publisher(String, "~/chain", KEEP_LAST)
        self._ros.create_subscription(UInt8MultiArray, "~/event", self._receive_event, 100)
        self._ros.create_timer(STATUS_PERIOD_S, self._publish_status)
        self._published_top = b""
        super().__init__(mission, directory, RosLoop(self._ros))

    def _receive_event(self, message: UInt8MultiArray) -> None:
        event = bytes(message.data)
        if event and 1 <= event[0] <= 254:
            self.log_event(event[0], event[1:])
        else:
            self._ros.get_logger().warning("the event is not logged: its first byte must be an ID from 1 to 254")

    def _feed(self, feed: Callable[[float], None]) -> None:
        super()._feed(feed)
        if self._published_top != (top := self.agent.state.chain.top_chain_hash):
            self._published_top = top
            chain = export_chain(self.agent.state, self.clock.timestamp_us(self.clock.now()))
            self._chain_out.publish(String(data=json.dumps(chain)))

    def _publish_status(self) -> None:
        self._status_out.publish(String(data=json.dumps(self._status({}))))

    def _status(self, request: dict[str, Any]) -> dict[str, object]:
        return {**super()._status(request), "version": f"rclpy on {rclpy.get_rmw_implementation_identifier()}"}


if __name__ == "__main__":
    os.environ.update(THIS_VEHICLE_ONLY)
    rclpy.init(args=NO_LOG_FILES, signal_handler_options=SignalHandlerOptions.NO)
    sys.exit(main(sys.argv[1:], RosAgent))
