"""ROS bags, of version 1 and 2, on a machine without ROS: the package `rosbags` knows the messages.

The thesis's agents were ROS nodes. By convention agent 7 has these topics, any of which may be missing:

/ucp/7/trace     std_msgs/String           lines of its trace, the header first
/ucp/7/sent      std_msgs/UInt8MultiArray  each datagram that it broadcast
/ucp/7/received  std_msgs/UInt8MultiArray  each datagram that reached it
/ucp/7/event     std_msgs/UInt8MultiArray  each event that it was given to log: its ID, and then its data
/ucp/7/chain     std_msgs/String           its chain export

The time of a datagram or an event is that at which the bag recorded it. Other names are a subclass away:

    class OurBags(RosBag):
        topics = {"/uav{agent}/swarm/rx": "received", "/uav{agent}/swarm/tx": "sent"}

and so are other types: `payload` says what a message says.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from harness.errors import MachineError
from harness.field.adapters.adapter import Adapter, ChainExport, Datagram, LoggedEvent, Observation, TraceLine, Unusable
from harness.field.adapters.bags import (
    MAGICS,
    BagMessage,
    messages,
)
from harness.field.adapters.bags._decompression import Broken, message_data

METADATA = "metadata.yaml"
_METADATA_BEGINS = b"rosbag2_bagfile_information"
_JOURNALS = ("-wal", "-shm")
_OTHERS_TOLD = 5


class RosBag(Adapter):
    """Reads bags; `topics` says what is on which, `{agent}` standing for the agent's ID.

    What is on a topic is `trace`, `sent`, `received`, `event` or `chain`.
    """

    counts = "message"
    topics: ClassVar[Mapping[str, str]] = {
        f"/ucp/{{agent}}/{kind}": kind for kind in ("trace", "sent", "received", "event", "chain")
    }

    def recognises(self, source: Path, beginning: bytes) -> bool:
        if source.name == METADATA:
            return _METADATA_BEGINS in beginning
        if source.name.endswith(_JOURNALS):
            return source.with_name(source.name[:-4]).is_file()
        return beginning.startswith(MAGICS)

    def part_of(self, source: Path) -> Path:
        """A bag of version 2 is a directory."""
        if (source.parent / METADATA).is_file():
            return source.parent
        return source.with_name(source.name[:-4]) if source.name.endswith(_JOURNALS) else source

    def observations(self, source: Path) -> Iterator[Observation]:
        if source.name == METADATA or source.name.endswith(_JOURNALS):
            return
        _types("ROS2_HUMBLE")  # to say at once that the package is missing
        others: Counter[str] = Counter()
        number = 0
        for message in messages(source):
            if isinstance(message, Broken):
                yield Unusable(message.why, number + 1, of_a_trace=True)
                continue
            number = message.number
            named = next((topic for topic in self._patterns if topic.fullmatch(message.topic)), None)
            agent = named and named.fullmatch(message.topic)
            if named is None or agent is None:
                others[message.topic] += 1
            else:
                yield from self._said(message, int(agent[1]), self._patterns[named])
        if others:
            names = ", ".join(topic[:60] for topic, _ in others.most_common(_OTHERS_TOLD))
            more = ", ..." if len(others) > _OTHERS_TOLD else ""
            yield Unusable(f"{others.total()} messages are on topics of no agent: {names}{more}")

    def payload(self, message: BagMessage) -> str | bytes:
        """The text of a String, and the bytes of a UInt8MultiArray. What it raises is told of the message."""
        content = self.decoded(message).data
        return content if isinstance(content, str) else bytes(content)

    def decoded(self, message: BagMessage) -> Any:
        """The message as rosbags has it, an object with the fields of its type."""
        data = message_data(message.data)
        if "/msg/" in message.type_name:
            return self._version_2.deserialize_cdr(data, message.type_name)
        return self._version_1.deserialize_ros1(data, message.type_name.replace("/", "/msg/"))

    def _said(self, message: BagMessage, agent: int, kind: str) -> Iterator[Observation]:
        number = message.number
        try:
            content = self.payload(message)
        except MachineError:
            raise
        except Exception as error:  # rosbags has many ways to say that bytes are no message of a type
            why = f"it is a damaged {message.type_name[:40] or 'message of a known type'} ({type(error).__name__})"
            yield Unusable(why, number, kind == "trace", agent)
            return
        text, data = (content, content.encode()) if isinstance(content, str) else ("", content)
        if kind in ("trace", "chain") and not isinstance(content, str):
            yield Unusable(f"it is a {message.type_name[:40]}, not a String", number)
        elif kind == "trace":
            yield from (TraceLine(agent, line, number) for line in text.splitlines() if line.strip())
        elif kind == "chain":
            yield ChainExport(text, number)
        elif kind == "event" and data:
            yield LoggedEvent(agent, message.time_ns, data[0], data[1:], number)
        elif kind in ("sent", "received"):
            yield Datagram(agent, message.time_ns, kind == "sent", data, number)
        else:
            yield Unusable("it contains no event", number)

    @cached_property
    def _patterns(self) -> dict[re.Pattern[str], str]:
        return {
            re.compile(re.escape(topic).replace(re.escape("{agent}"), r"(\d{1,5})")): kind
            for topic, kind in self.topics.items()
        }

    @cached_property
    def _version_1(self) -> Any:
        return _types("ROS1_NOETIC")

    @cached_property
    def _version_2(self) -> Any:
        return _types("ROS2_HUMBLE")


def _types(store: str) -> Any:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MachineError("reading ROS bags needs the package rosbags: `pip install ucp-harness[ros]`") from None
    return get_typestore(Stores[store])
