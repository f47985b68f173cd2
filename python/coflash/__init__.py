"""Converts firmware and flashes it over CANopen.

``flash`` puts a program into a device, ``info`` asks a device what it is, and ``scan`` who is on the
bus. A bus is a URL as the command line's ``--bus`` takes it. What goes wrong is an :class:`Error`.
"""

from ._native import __version__, flash, info, scan
from .errors import BusError, Cancelled, DeviceError, Error, FileError

__all__ = [
    "BusError",
    "Cancelled",
    "DeviceError",
    "Error",
    "FileError",
    "__version__",
    "flash",
    "info",
    "scan",
]
