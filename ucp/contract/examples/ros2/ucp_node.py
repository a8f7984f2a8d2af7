"""A UCP agent as a ROS 2 node: python ucp_node.py MISSION_FILE (docs/how-to/run-a-ros-node.md).

It is the harness's own agent in rclpy's main loop: ROS timers and a ROS executor drive it, and its blocks are made of
events that come as messages. UCP's own datagrams stay UDP broadcasts: they are for other vehicles, and ROS stays on
this one.

    ~/event   in   std_msgs/UInt8MultiArray   an event to be logged: its ID (1..254), then its data
    ~/status  out  std_msgs/String            what the control socket answers to `status`, in JSON, every second
    ~/chain   out  std_msgs/String            the chain export in JSON, whenever the chain is another

The node is /ucp/agent_7, for agent 7. The last messages of `status` and `chain` are there for who subscribes later.
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
from ucp.loop import Callback, Loop, Timer
from ucp.mission import Mission
from ucp.node import Node, main

STATUS_EVERY_S = 1.0
LATER_TOO = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

ON_THIS_VEHICLE = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "ROS_STATIC_PEERS": "",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}
"""ROS sends to loopback, and not through shared memory either, which vehicles of one machine would share: what is on
the air is UCP's."""

NO_FILES = ["--ros-args", "--disable-external-lib-logs"]
"""ROS leaves none: in a container an agent can write only where its mission file is."""


class RosLoop(Loop):
    """The loop of `ucp.loop`, run by a ROS executor: one ROS timer is set to what is due next.

    ROS does not wait for sockets. A thread does, and wakes the executor, which calls back.
    """

    def __init__(self, ros: RosNode) -> None:
        super().__init__()
        self._ros = ros
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(ros)
        self._timer = ros.create_timer(STATUS_EVERY_S, self._fired, autostart=False)
        self._wake_up = ros.create_guard_condition(self._sockets_are_ready)
        self._ready: list[Any] = []
        self._called_back = Semaphore(0)
        Thread(target=self._wait_for_sockets, daemon=True).start()

    def call_later(self, delay_s: float, callback: Callback) -> Timer:
        timer = super().call_later(delay_s, callback)
        self._set_timer()
        return timer

    def run(self) -> None:
        while self._running:
            self._executor.spin_once()
        self._running = True

    def _set_timer(self) -> None:
        """To what is due next."""
        delay_s = self._due_in_s()
        if delay_s is None:
            self._timer.cancel()
        else:
            self._timer.timer_period_ns = round(delay_s * 1e9)
            self._timer.reset()

    def _fired(self) -> None:
        self._call_what_is_due()
        self._set_timer()

    def _wait_for_sockets(self) -> None:
        while True:
            self._ready = self._selector.select()
            self._wake_up.trigger()
            self._called_back.acquire()

    def _sockets_are_ready(self) -> None:
        self._call_back(self._ready)
        self._called_back.release()


class RosAgent(Node):
    def __init__(self, mission: Mission, directory: Path) -> None:
        self._ros = rclpy.create_node(f"agent_{mission.agent_id}", namespace="ucp")
        self._status_out = self._ros.create_publisher(String, "~/status", LATER_TOO)
        self._chain_out = self._ros.create_publisher(String, "~/chain", LATER_TOO)
        self._ros.create_subscription(UInt8MultiArray, "~/event", self._event_came, 100)
        self._ros.create_timer(STATUS_EVERY_S, self._tell_status)
        self._told = b""
        super().__init__(mission, directory, RosLoop(self._ros))

    def _event_came(self, message: UInt8MultiArray) -> None:
        event = bytes(message.data)
        if event and 1 <= event[0] <= 254:
            self.log_event(event[0], event[1:])
        else:
            self._ros.get_logger().warning("an event begins with its ID, 1 to 254: not logged")

    def _drive(self, feed: Callable[[float], None]) -> None:
        super()._drive(feed)
        if self._told != (top := self.agent.state.chain.top_chain_hash):
            self._told = top
            chain = export_chain(self.agent.state, self.clock.timestamp_us(self.clock.now()))
            self._chain_out.publish(String(data=json.dumps(chain)))

    def _tell_status(self) -> None:
        self._status_out.publish(String(data=json.dumps(self._status({}))))

    def _status(self, request: dict[str, Any]) -> dict[str, Any]:
        return {**super()._status(request), "version": f"rclpy on {rclpy.get_rmw_implementation_identifier()}"}


if __name__ == "__main__":
    os.environ.update(ON_THIS_VEHICLE)
    rclpy.init(args=NO_FILES, signal_handler_options=SignalHandlerOptions.NO)
    sys.exit(main(sys.argv[1:], RosAgent))
