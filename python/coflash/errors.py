"""What can go wrong, with coflash's numbers."""


class Error(Exception):
    """Something went wrong: its stable number, what happened, and what to do next."""

    number: int
    what: str
    advice: str

    def __init__(self, number: int, what: str, advice: str) -> None:
        super().__init__(number, what, advice)
        self.number = number
        self.what = what
        self.advice = advice

    def __str__(self) -> str:
        text = f"{self.what} [{self.number:#010x}]"
        return f"{text}; {self.advice}" if self.advice else text


class FileError(Error):
    """The firmware file is no good, or does not fit the board. No device was touched."""


class BusError(Error):
    """The way to the bus is no good: its URL, the adapter, the server behind it."""


class DeviceError(Error):
    """The device does not do what it is told, or is not there."""


class Cancelled(Error):
    """The update was given up."""
