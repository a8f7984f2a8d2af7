"""Send events to a UCP agent that is a ROS 2 node: python talk.py AGENT_ID TEXT (docs/how-to/run-a-ros-node.md).

The program sends one event with the text per second, until the agent's chain has a block with it. It prints this block.
"""

import json
import os
import sys
from base64 import b64decode
from typing import Any

import rclpy
from rclpy.task import Future
from std_msgs.msg import String, UInt8MultiArray

from ucp.contract.examples.ros2.ucp_node import KEEP_LAST, NO_LOG_FILES, THIS_VEHICLE_ONLY
from ucp.events import decode_events

EVENT_ID = 1
PERIOD_S = 1.0


class Talker:
    """A ROS node that sends events to an agent. `done` is completed when the agent's chain contains the text."""

    def __init__(self, agent_id: int, text: str) -> None:
        self._text = text
        self._printed_status = False
        self.done = Future()
        self.ros = rclpy.create_node(f"talker_to_{agent_id}", namespace="ucp")
        agent = f"/ucp/agent_{agent_id}"
        event = UInt8MultiArray(data=bytes([EVENT_ID, *text.encode()]))
        event_out = self.ros.create_publisher(UInt8MultiArray, f"{agent}/event", 10)
        self.ros.create_timer(PERIOD_S, lambda: event_out.publish(event))
        self.ros.create_subscription(String, f"{agent}/status", self._receive_status, KEEP_LAST)
        self.ros.create_subscription(String, f"{agent}/chain", self._receive_chain, KEEP_LAST)

    def _receive_status(self, message: String) -> None:
        status: dict[str, Any] = json.loads(message.data)
        if not self._printed_status:
            self._printed_status = True
            self._print_line(f"agent {status['agent_id']}: {status['chain']} blocks in its chain, {status['version']}")

    def _receive_chain(self, message: String) -> None:
        for number, block in enumerate(json.loads(message.data)["chain"], 1):
            texts = [event.data.decode(errors="replace") for event in decode_events(b64decode(block["event_data"]))]
            if self._text in texts and not self.done.done():
                self._print_line(f"block {number}: {', '.join(texts)}")
                self.done.set_result(None)

    def _print_line(self, line: str) -> None:
        sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    os.environ.update(THIS_VEHICLE_ONLY)
    rclpy.init(args=NO_LOG_FILES)
    talker = Talker(int(sys.argv[1]), sys.argv[2])
    rclpy.spin_until_future_complete(talker.ros, talker.done)
