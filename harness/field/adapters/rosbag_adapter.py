"""Read ROS bags of versions 1 and 2 without an installation of ROS. The package `rosbags` decodes the messages.

The agents of the thesis were ROS nodes. By convention agent 7 has the following topics, some of which may be missing:

/ucp/7/trace     std_msgs/String           lines of its trace, the header first
/ucp/7/sent      std_msgs/UInt8MultiArray  each datagram that it broadcast
/ucp/7/received  std_msgs/UInt8MultiArray  each datagram that it received
/ucp/7/event     std_msgs/UInt8MultiArray  each event that it received for logging: its ID, then its data
/ucp/7/chain     std_msgs/String           its chain export

The time of a datagram or an event is the time at which the bag recorded it. A subclass can use other topic names:

    class OurBags(RosBag):
        topics = {"/uav{agent}/swarm/rx": "received", "/uav{agent}/swarm/tx": "sent"}

A subclass can also use other message types by overriding `payload`.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from harness.errors import MachineError, extra
from harness.field.adapters.adapter import Adapter, ChainExport, Datagram, LoggedEvent, Observation, TraceLine, Unusable
from harness.field.adapters.bags import MAGICS, BagMessage, messages
from harness.field.adapters.bags._decompression import UnreadablePart, message_data

METADATA = "metadata.yaml"
_METADATA_BEGINS = b"rosbag2_bagfile_information"
_JOURNALS = ("-wal", "-shm")
_MAX_TOPICS_LISTED = 5


class RosBag(Adapter):
    """The adapter for ROS bags. `topics` maps each topic name to the kind of records on this topic: `trace`, `sent`,
    `received`, `event` or `chain`. In a topic name, `{agent}` stands for an agent ID.
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
        """Return the directory of a ROS bag of version 2, or the file of a ROS bag of version 1."""
        if (source.parent / METADATA).is_file():
            return source.parent
        return source.with_name(source.name[:-4]) if source.name.endswith(_JOURNALS) else source

    def observations(self, source: Path) -> Iterator[Observation]:
        if source.name == METADATA or source.name.endswith(_JOURNALS):
            return
        _types("ROS2_HUMBLE")  # Report a missing package before reading.
        other_topics: Counter[str] = Counter()
        number = 0
        for message in messages(source):
            if isinstance(message, UnreadablePart):
                yield Unusable(message.why, number + 1, of_a_trace=True)
                continue
            number = message.number
            pattern = next((topic for topic in self._patterns if topic.fullmatch(message.topic)), None)
            agent = pattern and pattern.fullmatch(message.topic)
            if pattern is None or agent is None:
                other_topics[message.topic] += 1
            else:
                yield from self._observations(message, int(agent[1]), self._patterns[pattern])
        if other_topics:
            names = ", ".join(topic[:60] for topic, _ in other_topics.most_common(_MAX_TOPICS_LISTED))
            more = ", ..." if len(other_topics) > _MAX_TOPICS_LISTED else ""
            yield Unusable(f"{other_topics.total()} messages are on topics of no agent: {names}{more}")

    def payload(self, message: BagMessage) -> str | bytes:
        """Return the text of a String message, or the bytes of a UInt8MultiArray message.

        Exceptions are reported with the number of the message.
        """
        content = self.decoded(message).data
        return content if isinstance(content, str) else bytes(content)

    def decoded(self, message: BagMessage) -> Any:
        """Decode a message. The attributes of the returned object are the fields of its ROS type."""
        data = message_data(message.data)
        if "/msg/" in message.type_name:
            return self._version_2.deserialize_cdr(data, message.type_name)
        return self._version_1.deserialize_ros1(data, message.type_name.replace("/", "/msg/"))

    def _observations(self, message: BagMessage, agent: int, kind: str) -> Iterator[Observation]:
        number = message.number
        try:
            content = self.payload(message)
        except MachineError:
            raise
        except Exception as error:  # rosbags raises many kinds of exceptions for damaged messages.
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
    with extra("ros", "reading a ROS bag"):
        from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores[store])
