"""The package against `coboot-node` over TCP (socketcand), as a test bench uses it.

``COBOOT_NODE`` names the program; ``tests/foreign/python_package.rs`` builds package and program, and
runs this file.
"""

import ast
import inspect
import json
import os
import pathlib
import queue
import signal
import subprocess
import sys
import threading
import time
import zlib

import pytest

import coflash

BASE = 0x0802_0000
BOARD = "stm32f407g-disc1"


def program() -> bytes:
    """The part of a program that a bootloader checks: stack pointer in RAM, reset vector inside."""
    vectors = (0x2001_0000).to_bytes(4, "little") + (BASE + 0x201).to_bytes(4, "little")
    return vectors + bytes([0xA5]) * (20 * 1024 - 8)


def crc32(data: bytes) -> int:
    """The CRC of 1F56h (manual L-1112d_10, chapter 3.1), computed by Python's own library."""
    return zlib.crc32(data)


class Nodes:
    """Nodes with their own bus."""

    def __init__(self, folder, *arguments):
        command = [os.environ["COBOOT_NODE"], "--listen", "127.0.0.1:0", *arguments]
        self.process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
        line = self.process.stdout.readline()
        assert line.startswith("bus: "), line
        self.bus = line.removeprefix("bus: ").strip()
        # Keep reading, so that the pipe does not fill up.
        threading.Thread(target=self.process.stdout.read, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


@pytest.fixture
def nodes(tmp_path):
    with Nodes(tmp_path, "--node", "5", "--count", "2", "--flash", "instant", "--stand-in") as nodes:
        yield nodes


@pytest.fixture
def image(tmp_path):
    path = tmp_path / "program.bin"
    path.write_bytes(program())
    return path


def test_flash_info_and_scan(nodes, image):
    events = []
    report = coflash.flash(nodes.bus, 5, image, events.append, board=BOARD, address=BASE, verify=True)
    assert report["size"] == len(program())
    assert report["crc"] == crc32(program())
    assert report["dialect"] == "block"

    kinds = [event["event"] for event in events]
    assert kinds[0] == "found" and kinds[-1] == "done"
    assert {event["node"] for event in events} == {5}
    progress = [event for event in events if event["event"] == "progress"]
    assert progress[-1]["done"] == progress[-1]["total"] > len(program())
    assert events[-1]["state"] == "released" and events[-1]["error"] is None
    assert events[-1]["report"] == report
    assert all(isinstance(event["text"], str) for event in events)

    info = coflash.info(nodes.bus, 5)
    assert (info["node"], info["bootloader"]) == (5, False)
    assert info["programs"][0]["crc"] == crc32(program())

    found = coflash.scan(nodes.bus, [4, 5, 6], listen=0)
    assert sorted(found) == [5, 6]
    assert found[6]["info"]["bootloader"] is True


def test_without_a_listener(nodes, image):
    assert coflash.flash(nodes.bus, 6, str(image), board=BOARD, address=BASE)["blocks_repeated"] == 0


def test_an_error_has_number_text_and_advice(nodes, image):
    with pytest.raises(coflash.DeviceError) as caught:
        coflash.info(nodes.bus, 99, sdo_timeout=0.01)
    error = caught.value
    # The manual's number for a device that does not answer (L-1112e_5, table 5).
    assert error.number == 0x6000_0013
    assert "node 99 does not answer" in error.what and error.advice
    assert "[0x60000013]" in str(error) and isinstance(error, coflash.Error)

    with pytest.raises(coflash.BusError) as caught:
        coflash.info("socketcand://127.0.0.1:1/can0", 5)
    assert caught.value.number == 0x6000_0301
    with pytest.raises(coflash.BusError):
        coflash.scan("nothing")


def test_the_file_is_read_before_the_bus_is_opened(tmp_path):
    nowhere = "socketcand://127.0.0.1:1/can0"
    with pytest.raises(coflash.FileError) as caught:
        coflash.flash(nowhere, 5, tmp_path / "absent.elf")
    assert "absent.elf" in caught.value.what and caught.value.number == 2  # ENOENT
    path = tmp_path / "program.bin"
    path.write_bytes(program())
    with pytest.raises(coflash.FileError) as caught:
        coflash.flash(nowhere, 5, path, board=BOARD, address=0x0900_0000)
    # "Data outside": the manual's number.
    assert caught.value.number == 0x6000_0015


def sealed(program=1, cut=0) -> bytes:
    """A sealed image with an invalid signature, by the table of the format (docs/protocol.md)."""
    image = bytes([0x5A]) * 600
    manifest = bytearray(176)
    manifest[:8] = b"CBS1" + len(manifest).to_bytes(2, "little") + bytes([1, 0])
    # 4096 bytes of payload to a chunk, for any bootloader that knows the format.
    manifest[24:28] = bytes([program, 12, 1, 0])
    manifest[28:40] = b"".join(word.to_bytes(4, "little") for word in (len(image), crc32(image), len(image)))
    signature = (1).to_bytes(4, "little") + bytes([1, 0, 64, 0]) + bytes(64)
    file = bytes(manifest) + signature + bytes(32) + image
    return file[: len(file) - cut]


def test_a_sealed_image_is_read_before_the_bus_is_opened(tmp_path):
    nowhere = "socketcand://127.0.0.1:1/can0"
    path = tmp_path / "program.cbs"
    # The device's errors would be 82h in 1F57h, wrong product, and the manual's number of a wrong format.
    for file, number, words in [
        (sealed(program=2), 0x6000_0182, "it is for program 2, and program 1 is to be written"),
        (sealed(cut=1), 0x6000_0002, "it is cut off"),
        (b"CBS1" + bytes(200), 0x6000_0002, "the head is damaged"),
    ]:
        path.write_bytes(file)
        with pytest.raises(coflash.FileError) as caught:
            coflash.flash(nowhere, 5, path)
        assert caught.value.number == number, hex(caught.value.number)
        assert str(path) in caught.value.what and words in caught.value.what and caught.value.advice
    # A well-formed one is accepted; the options for other files have no effect on it.
    path.write_bytes(sealed())
    with pytest.raises(coflash.BusError):
        coflash.flash(nowhere, 5, path, board=BOARD, address=BASE, check_target=True)


def test_a_device_without_sealed_images_refuses_one(nodes, tmp_path):
    path = tmp_path / "program.cbs"
    path.write_bytes(sealed())
    with pytest.raises(coflash.DeviceError) as caught:
        coflash.flash(nodes.bus, 5, path)
    # The manual's number for a wrong format.
    assert caught.value.number == 0x6000_0002, str(caught.value)
    assert coflash.info(nodes.bus, 5)["bootloader"] is True


@pytest.mark.parametrize(
    "arguments",
    [
        {"node": 0},
        {"node": 128},
        {"program": 0},
        {"program": 2},
        {"board": "nothing"},
        {"dialect": "latin"},
        {"unlock": ""},
        {"sdo_timeout": -1.0},
        {"sdo_timeout": float("nan")},
        {"check_target": True},
    ],
)
def test_wrong_arguments_are_value_errors(image, arguments):
    arguments = {"node": 5, "board": BOARD, "address": BASE, **arguments}
    with pytest.raises(ValueError):
        coflash.flash("socketcand://127.0.0.1:1/can0", arguments.pop("node"), image, **arguments)


def test_what_the_listener_raises_ends_the_update_and_comes_out(nodes, image):
    class Enough(Exception):
        pass

    heard = []

    def listen(event):
        heard.append(event["event"])
        if event["event"] == "progress" and event["done"] > 4096:
            raise Enough

    with pytest.raises(Enough):
        coflash.flash(nodes.bus, 5, image, listen, board=BOARD, address=BASE)
    # There were no events since, and the device accepts the next attempt.
    assert heard[-1] == "progress"
    assert coflash.info(nodes.bus, 5)["bootloader"] is True
    assert coflash.flash(nodes.bus, 5, image, board=BOARD, address=BASE)["size"] == len(program())


def test_other_threads_run_while_it_works(nodes):
    ticks = queue.Queue()
    stop = threading.Event()

    def tick():
        while not stop.is_set():
            ticks.put(None)
            stop.wait(0.001)

    ticker = threading.Thread(target=tick)
    ticker.start()
    try:
        before = ticks.qsize()
        with pytest.raises(coflash.DeviceError):
            # It sends requests for five seconds, and releases Python's lock during that time.
            coflash.info(nodes.bus, 99, sdo_timeout=0.1)
        during = ticks.qsize() - before
    finally:
        stop.set()
        ticker.join()
    # Five seconds have room for thousands. If the lock were held, there would be almost none.
    assert during > 20, during


@pytest.mark.skipif(sys.platform == "win32", reason="there is no such signal")
def test_ctrl_c_ends_it(nodes):
    # A shell starts background processes with this signal ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main = threading.main_thread().ident

    def interrupt():
        # After the work has begun: it would last five seconds.
        time.sleep(0.3)
        signal.pthread_kill(main, signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        coflash.info(nodes.bus, 99, sdo_timeout=5.0)
    # The bus is free again.
    assert coflash.info(nodes.bus, 5)["node"] == 5


def test_the_stubs_are_those_of_the_functions():
    stubs = os.path.join(os.path.dirname(coflash.__file__), "_native.pyi")
    with open(stubs, encoding="utf-8") as file:
        tree = ast.parse(file.read())
    stubs = {item.name: item.args for item in tree.body if isinstance(item, ast.FunctionDef)}
    assert set(stubs) == {"flash", "info", "scan"}
    for name, stub in stubs.items():
        positional = stub.args
        told = {argument.arg: None for argument in positional}
        for argument, default in zip(positional[len(positional) - len(stub.defaults) :], stub.defaults):
            told[argument.arg] = ast.literal_eval(default)
        for argument, default in zip(stub.kwonlyargs, stub.kw_defaults):
            told[argument.arg] = ast.literal_eval(default)
        empty = inspect.Parameter.empty
        real = inspect.signature(getattr(coflash, name)).parameters.values()
        assert told == {it.name: None if it.default is empty else it.default for it in real}
        keyword = [it.name for it in real if it.kind is it.KEYWORD_ONLY]
        assert keyword == [argument.arg for argument in stub.kwonlyargs]


def test_the_package_is_typed():
    folder = os.path.dirname(coflash.__file__)
    assert os.path.exists(os.path.join(folder, "py.typed"))
    assert os.path.exists(os.path.join(folder, "_native.pyi"))
    assert coflash.__version__.count(".") == 2


FATES = ("", "absent", "cut-before", "dies", "returns", "unplugged", "KILL")
OPTIONS = {"--no-start": {"start": False}, "--no-trial": {"trial_run": False}}


def rows():
    """The rows of the table of `coboot-node` (sim/node/tests/it/outcomes.rs) that this file can make: those for one
    device with raw images."""
    table = pathlib.Path(__file__).parents[3] / "sim/node/tests/it/outcomes.json"
    for row in json.loads(table.read_text()):
        files = row["before"] + row["gets"]
        is_raw = all(letter in "0123456789-pzd" for letter in files) and row["gets"][2] == "0"
        if is_raw and "one" in row.get("ways", "one").split() and row.get("fate", "") in FATES:
            yield pytest.param(row, id=row["what"])


def file(name: str) -> bytes:
    """The image of a file of the table: plain, or with its own CRC-32 at the end as zlib or DFU have it."""
    data = program()[:8] + name[:1].encode() * (96 * 1024 - 8)
    if name[3] == "p":
        return data
    return data[:-4] + (zlib.crc32(data[:-4]) ^ (0xFFFF_FFFF if name[3] == "d" else 0)).to_bytes(4, "little")


def options(words: str) -> dict:
    first, *more = words.split() or [""]
    return {"unlock": more[0]} if first == "--unlock" else OPTIONS.get(first, {})


class Enough(Exception):
    """The listener ends the update."""


@pytest.mark.parametrize("row", list(rows()))
def test_what_is_said_is_in_the_flash(tmp_path, row):
    """The reader is this file: it compares the bytes of the flash."""
    fate, new = row.get("fate", ""), file(row["gets"])
    script = tmp_path / "run.sh"
    script.write_text("#!/bin/sh\ngrep -q 22222222 \"$1\" && exit 3\nexec sleep 1000\n")
    script.chmod(0o755)
    bus = Nodes(tmp_path, "--node", "77", "--serial", "77")

    def switched_on():
        node = "15" if fate == "absent" else "5"
        speed = "typical" if fate in FATES[2:] else "instant"
        words = [os.environ["COBOOT_NODE"], "--bus", bus.bus, "--node", node, "--flash", speed]
        words += ["--vendor-id", "0x3F", "--product-code", "3", *row.get("device", "--stand-in").split()]
        device = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
        assert "bootloader" in device.stdout.readline()
        return device

    def held(data=new):
        return (tmp_path / "1.flash").read_bytes()[0x2_0000:][: len(data)]

    def flash(name, strike, words=""):
        """The state in the last event, and whether the update was good."""
        path, events, over = tmp_path / f"{name}.bin", [], threading.Event()
        path.write_bytes(file(name))

        def is_in_the_middle():
            # The first bytes after the vectors are those of this file.
            return held()[8:8192] == file(name)[8:8192]

        def watch():
            while not over.wait(0.002):
                if is_in_the_middle():
                    return strike()

        def note(event):
            events.append(event)
            if strike is enough and is_in_the_middle():
                strike()

        watcher = threading.Thread(target=watch)
        if strike not in (None, enough):
            watcher.start()
        try:
            coflash.flash(bus.bus, 5, path, note, board=BOARD, address=BASE, **options(words))
        except (coflash.Error, Enough) as error:
            return events[-1].get("state"), str(error)
        finally:
            over.set()
        return events[-1]["state"], None

    def enough():
        raise Enough

    device = switched_on()
    try:
        if row["before"] and fate != "absent":
            flash(row["before"], enough if fate == "cut-before" else None, row.get("before-with", ""))
        before = held()
        strikes = {"unplugged": bus.process.kill, "KILL": enough, "dies": device.kill, "returns": device.kill}
        said, error = flash(row["gets"], strikes.get(fate), row.get("with", ""))
        if fate in ("returns", "KILL"):
            if fate == "returns":
                device.wait()
                device = switched_on()
            said, error = flash(row["gets"], None)
        # In the words of the table.
        said = {"called": "untouched", "released": "updated", "written": "updated"}.get(said, said)
        assert said == row["said"], error
        has = "new" if held() == new else "old" if held() == before else "none"
        assert has == {"untouched": "old", "erased": "none"}.get(said, "new"), error
    finally:
        for process in device, bus.process:
            process.kill()
            process.wait()
