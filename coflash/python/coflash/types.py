"""The types of the functions' results: dictionaries with stable keys."""

from typing import Any, Dict, List, Optional, TypedDict


class Status(TypedDict):
    """1F57h of a program."""

    word: int
    busy: bool
    error: Optional[int]
    error_text: Optional[str]
    detail: int


class Program(TypedDict):
    """One program of a device: 1F51h, 1F56h and 1F57h at its number."""

    number: int
    control: Optional[int]
    crc: Optional[int]
    status: Optional[Status]


class DeviceInfo(TypedDict):
    """What a device reports about itself; ``None`` for an object that it does not have."""

    node: int
    device_type: int
    bootloader: bool
    error_register: Optional[int]
    name: Optional[str]
    hardware_version: Optional[str]
    software_version: Optional[str]
    vendor_id: Optional[int]
    product_code: Optional[int]
    revision: Optional[int]
    serial_number: Optional[int]
    dialect: Optional[str]
    programs: List[Program]


class Found(TypedDict):
    """A node that answers or was heard."""

    #: What its heartbeat says, in words.
    state: Optional[str]
    #: ``None`` where it does not answer.
    info: Optional[DeviceInfo]


class Report(TypedDict):
    """The results of an update."""

    size: int
    crc: int
    blocks_repeated: int
    seconds: float
    transfer_seconds: float
    transfer: str
    running: Optional[int]
    dialect: str


#: What happens during an update: ``event`` is its kind (found, phase, progress, retry, note, warning
#: or done), ``node`` the device and ``text`` words for people. What else is in it depends on the kind.
Event = Dict[str, Any]
