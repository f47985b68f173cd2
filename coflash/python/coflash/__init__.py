"""Converts firmware and flashes it over CANopen.

``flash`` downloads a program into a device, ``info`` reads a device's information, and ``scan`` lists
the nodes on the bus. A bus is a URL as for the command line's ``--bus``. Errors are raised as
:class:`Error`.
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
