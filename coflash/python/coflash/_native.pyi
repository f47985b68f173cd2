import os
from typing import Callable, Dict, Optional, Sequence, Union

from .types import DeviceInfo, Event, Found, Report

__version__: str

def flash(
    bus: str,
    node: int,
    file: Union[str, "os.PathLike[str]"],
    on_event: Optional[Callable[[Event], object]] = None,
    *,
    board: Optional[str] = None,
    address: Optional[int] = None,
    program: int = 1,
    check_target: bool = False,
    trial_run: bool = True,
    start: bool = True,
    verify: bool = False,
    repeats: int = 3,
    dialect: Optional[str] = None,
    unlock: Optional[str] = None,
    sdo_timeout: float = 0.5,
) -> Report: ...
def info(bus: str, node: int, *, sdo_timeout: float = 0.5) -> DeviceInfo: ...
def scan(bus: str, nodes: Optional[Sequence[int]] = None, *, listen: float = 1.1) -> Dict[int, Found]: ...
