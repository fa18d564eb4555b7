"""DDS participant on one network interface, with topics that send and receive raw bytes.

Only cyclonedds 0.10 works with a Go2: version 11 crashes 0.10 peers, and does not discover them on a loopback
interface.
"""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
from pathlib import Path
from typing import Any, Generic, TypeVar
from xml.sax.saxutils import quoteattr

from surefoot.errors import SurefootError, choices

_T = TypeVar("_T")
LOW_STATE_TOPIC, LOW_COMMAND_TOPIC = "rt/lowstate", "rt/lowcmd"
SPORT_STATE_TOPIC = "rt/sportmodestate"
_SIOCGIFADDR = 0x8915
_IFF_UP, _IFF_MULTICAST = 0x1, 0x1000
_CONFIG = (
    "<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface name={} priority='default'"
    " multicast='{}'/></Interfaces>{}<Tracing><Verbosity>none</Verbosity></Tracing></Domain></CycloneDDS>"
)
_MULTICAST = "default", "</General>"
_NO_MULTICAST = (
    "false",
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='localhost'/></Peers></Discovery>",
)
"""The default of cyclonedds on a loopback interface without multicast; set explicitly, it prints no warning."""


def _flags(interface: str) -> int:
    return int((Path("/sys/class/net") / interface / "flags").read_text(), 16)


def check_interface(name: str) -> str:
    """Return the IPv4 address of a network interface that is up.

    Raises:
        SurefootError: the interface does not exist, is down, has no cable or no address.
    """
    names = [name for _, name in socket.if_nameindex()]
    if name not in names:
        raise SurefootError(f"there is no network interface '{name}'; it must be one of {choices(sorted(names))}")
    folder = Path("/sys/class/net") / name
    with contextlib.suppress(OSError, ValueError):
        if not _flags(name) & _IFF_UP:
            raise SurefootError(f"network interface {name} is down; it must be up: sudo ip link set {name} up")
        if (folder / "operstate").read_text().strip() == "down":
            raise SurefootError(f"network interface {name} has no carrier; check the cable, and that the robot is on")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))
        except OSError as error:
            raise SurefootError(
                f"network interface {name} has no IPv4 address; it must have one in the robot's network: "
                f"sudo ip address add 192.168.123.222/24 dev {name}"
            ) from error
    return socket.inet_ntoa(answer[20:24])


def _program(participant: Any) -> str:
    """Return the program name, process and computer of another program's participant."""
    properties = {one.key: one.value for one in participant.qos if type(one).__name__ == "Property"}
    name, host = properties.get("__ProcessName", "a program"), properties.get("__Hostname")
    process = f"process {properties['__Pid']}" if "__Pid" in properties else ""
    where = " on ".join(part for part in (process, host) if part)
    return f"{name} ({where})" if where else name


class Bus:
    """Participant of a DDS domain on one network interface. A process can have one domain, and one bus at a time.

    Raises:
        SurefootError: no cyclonedds, an interface that cannot be used, or a domain with too many programs.
    """

    def __init__(self, interface: str, domain: int = 0) -> None:
        check_interface(interface)
        try:
            from cyclonedds.core import DDSException
            from cyclonedds.domain import Domain, DomainParticipant
        except ImportError as error:
            raise SurefootError(
                'a link over DDS needs cyclonedds 0.10: pip install -c constraints.txt -e ".[dds]"'
            ) from error
        try:
            discovery = _MULTICAST if _flags(interface) & _IFF_MULTICAST else _NO_MULTICAST
            self._domain = Domain(domain, _CONFIG.format(quoteattr(interface), *discovery))
            self.participant = DomainParticipant(domain)
        except DDSException as error:
            raise SurefootError(
                f"DDS does not start in domain {domain} on {interface}: {error}; on a loopback interface without "
                "multicast, a domain is limited to nine programs"
            ) from error

    def type_names(self, topic: str) -> list[str]:
        """Return the type names of a topic's writers that DDS has discovered."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        writers = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).take(1000)
        return sorted({writer.type_name for writer in writers if writer.topic_name == topic})

    def writer_names(self, topic: str) -> list[str]:
        """Return the programs that write a topic, by name and process, as far as DDS has discovered them."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication

        writers = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).take(1000)
        programs = BuiltinDataReader(self.participant, BuiltinTopicDcpsParticipant).take(1000)
        keys = {str(writer.participant_key) for writer in writers if writer.topic_name == topic}
        names = {str(one.key): _program(one) for one in programs if one.key != self.participant.guid}
        return sorted(names.get(key, "an unknown program") for key in keys)

    def close(self) -> None:
        """Leave the domain, and delete all readers and writers of this bus."""
        for entity in (self.participant, self._domain):
            entity.__del__()

    def topic(self, name: str, kind: type[_T]) -> Any:
        """Return a topic with a message type of `types`."""
        from cyclonedds.topic import Topic

        return Topic(self.participant, name, kind)

    def writer(self, name: str, kind: type[_T]) -> RawWriter:
        """Return a reliable writer of a topic that keeps the last message."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.util import duration

        reliable = Policy.Reliability.Reliable(max_blocking_time=duration(milliseconds=1))
        qos = Qos(reliable, Policy.History.KeepLast(1))
        return RawWriter(self, DataWriter(self.participant, self.topic(name, kind), qos))

    def reader(self, name: str, kind: type[_T], depth: int = 1, others: bool = False) -> RawReader[_T]:
        """Return a best-effort reader of a topic that keeps the last `depth` messages.

        `others` is whether to ignore messages of this bus's own writers.
        """
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader

        policies = [Policy.Reliability.BestEffort, Policy.History.KeepLast(depth)]
        if others:
            policies.append(Policy.IgnoreLocal.Participant)
        return RawReader(self, DataReader(self.participant, self.topic(name, kind), Qos(*policies)), kind)


class RawWriter:
    """Writer of messages that are already encoded."""

    def __init__(self, bus: Bus, writer: Any) -> None:
        from cyclonedds._clayer import ddspy_write

        self._bus = bus  # DDS deletes the writer together with its participant
        self._writer, self._write = writer, ddspy_write

    @property
    def readers(self) -> int:
        """Number of readers of the topic that DDS has discovered."""
        return max(int(self._writer._dll_handle.dds_get_matched_subscriptions(self._writer._ref, None, 0)), 0)

    def write(self, data: bytes) -> bool:
        """Write a message with CDR header and a length that is a multiple of 4; return whether DDS accepted it."""
        return bool(self._write(self._writer._ref, data) >= 0)

    def write_message(self, message: Any) -> bool:
        """Encode and write a message of `types`, which takes a few tenths of a millisecond."""
        data = message.serialize()
        return self.write(data + bytes(-len(data) % 4))


class RawReader(Generic[_T]):
    """Reader of encoded messages; never waits."""

    def __init__(self, bus: Bus, reader: Any, kind: type[_T]) -> None:
        from cyclonedds._clayer import ddspy_take

        self._bus = bus
        self._reader, self._take, self._kind = reader, ddspy_take, kind

    def take(self, count: int = 16) -> list[bytes]:
        """Remove and return at most `count` messages with their CDR headers, oldest first."""
        taken = self._take(self._reader._ref, count)
        return [] if isinstance(taken, int) else [data for data, info in taken if info.valid_data]

    def take_messages(self, count: int = 16) -> list[_T]:
        """Return decoded messages of `types`, without damaged ones; takes a few tenths of a millisecond each."""
        messages = []
        for data in self.take(count):
            # The exception of a damaged message depends on where its bytes end.
            with contextlib.suppress(Exception):
                messages.append(self._kind.deserialize(data))  # type: ignore[attr-defined]
        return messages
