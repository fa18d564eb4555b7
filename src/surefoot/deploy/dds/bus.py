"""Topics of a DDS domain: raw bytes in and out, through one network interface.

Only cyclonedds 0.10 works with a Go2: version 11 makes peers of 0.10 crash, and does not find them on a loopback.
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
"""What cyclonedds does by itself on a loopback without multicast; said outright, it prints no warning."""


def _flags(interface: str) -> int:
    return int((Path("/sys/class/net") / interface / "flags").read_text(), 16)


def check_interface(name: str) -> str:
    """Return the IPv4 address of a network interface that is up.

    Raises:
        SurefootError: no such interface, one that is down or has no cable, or one without an address.
    """
    names = [name for _, name in socket.if_nameindex()]
    if name not in names:
        raise SurefootError(f"there is no network interface '{name}'; it must be one of {choices(sorted(names))}")
    folder = Path("/sys/class/net") / name
    with contextlib.suppress(OSError, ValueError):
        if not _flags(name) & _IFF_UP:
            raise SurefootError(f"network interface {name} is down; it must be up: sudo ip link set {name} up")
        if (folder / "operstate").read_text().strip() == "down":
            raise SurefootError(f"network interface {name} has no carrier; check the cable and the robot's switch")
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
    """Return the name, process and computer of a participant that another program has announced."""
    told = {one.key: one.value for one in participant.qos if type(one).__name__ == "Property"}
    name, place = told.get("__ProcessName", "a program"), told.get("__Hostname")
    process = f"process {told['__Pid']}" if "__Pid" in told else ""
    where = " on ".join(part for part in (process, place) if part)
    return f"{name} ({where})" if where else name


class Bus:
    """A participant of a DDS domain on one interface; a process has one domain, and at most one bus of it at a time.

    Raises:
        SurefootError: no cyclonedds, an interface that does not carry, or a domain that has no room.
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
                f"DDS does not start in domain {domain} on {interface}: {error}; on a loopback without multicast "
                "a domain has room for nine programs"
            ) from error

    def type_names(self, name: str) -> list[str]:
        """Return the types with which others write a topic, as far as DDS has found them."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        found = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).take(1000)
        return sorted({entry.type_name for entry in found if entry.topic_name == name})

    def writer_names(self, name: str) -> list[str]:
        """Return the programs that announce to write a topic, as far as DDS has found them, by name and process."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication

        writers = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication).take(1000)
        programs = BuiltinDataReader(self.participant, BuiltinTopicDcpsParticipant).take(1000)
        keys = {str(one.participant_key) for one in writers if one.topic_name == name}
        found = {str(one.key): _program(one) for one in programs if one.key != self.participant.guid}
        return sorted(found.get(key, "an unknown program") for key in keys)

    def close(self) -> None:
        """Leave the domain, with all readers and writers of this bus."""
        for entity in (self.participant, self._domain):
            entity.__del__()

    def topic(self, name: str, kind: type[_T]) -> Any:
        """Return a topic with the type `kind` of `types`."""
        from cyclonedds.topic import Topic

        return Topic(self.participant, name, kind)

    def writer(self, name: str, kind: type[_T]) -> RawWriter:
        """Return a writer of a topic: reliable, the last message kept."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.util import duration

        reliable = Policy.Reliability.Reliable(max_blocking_time=duration(milliseconds=1))
        qos = Qos(reliable, Policy.History.KeepLast(1))
        return RawWriter(self, DataWriter(self.participant, self.topic(name, kind), qos))

    def reader(self, name: str, kind: type[_T], depth: int = 1, others: bool = False) -> RawReader[_T]:
        """Return a reader of a topic, best effort, that keeps the last `depth` messages.

        `others`: without the messages of this bus's own writers.
        """
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader

        policies = [Policy.Reliability.BestEffort, Policy.History.KeepLast(depth)]
        if others:
            policies.append(Policy.IgnoreLocal.Participant)
        return RawReader(self, DataReader(self.participant, self.topic(name, kind), Qos(*policies)), kind)


class RawWriter:
    """Writes messages that are packed already."""

    def __init__(self, bus: Bus, writer: Any) -> None:
        from cyclonedds._clayer import ddspy_write

        self._bus = bus  # with its participant, DDS deletes all that is in it
        self._writer, self._write = writer, ddspy_write

    @property
    def readers(self) -> int:
        """Number of readers of the topic that DDS has found."""
        return max(int(self._writer._dll_handle.dds_get_matched_subscriptions(self._writer._ref, None, 0)), 0)

    def write(self, data: bytes) -> bool:
        """Write a message with its CDR header, its length a multiple of 4; return whether DDS has taken it."""
        return bool(self._write(self._writer._ref, data) >= 0)

    def write_message(self, message: Any) -> bool:
        """Write a message of `types`, which takes some tenths of a millisecond."""
        data = message.serialize()
        return self.write(data + bytes(-len(data) % 4))


class RawReader(Generic[_T]):
    """Reads messages as bytes; never waits."""

    def __init__(self, bus: Bus, reader: Any, kind: type[_T]) -> None:
        from cyclonedds._clayer import ddspy_take

        self._bus = bus
        self._reader, self._take, self._kind = reader, ddspy_take, kind

    def take(self, count: int = 16) -> list[bytes]:
        """Return at most `count` messages with their CDR headers, oldest first, and forget them."""
        taken = self._take(self._reader._ref, count)
        return [] if isinstance(taken, int) else [data for data, info in taken if info.valid_data]

    def take_messages(self, count: int = 16) -> list[_T]:
        """Return messages of `types`, which takes some tenths of a millisecond each; damaged ones are left out."""
        messages = []
        for data in self.take(count):
            # What a damaged message raises depends on where its bytes end: errors of struct, of text, of lengths.
            with contextlib.suppress(Exception):
                messages.append(self._kind.deserialize(data))  # type: ignore[attr-defined]
        return messages
