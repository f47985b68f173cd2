"""The errors of the package, with coflash's numbers."""


class Error(Exception):
    """An error: its stable number, what happened, and what to do next."""

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
    """The firmware file is invalid, or does not match the board. No device was changed."""


class BusError(Error):
    """The bus cannot be used: its URL, its adapter or its server has an error."""


class DeviceError(Error):
    """The device does not answer, or it does not carry out a command."""


class Cancelled(Error):
    """The update was cancelled."""
