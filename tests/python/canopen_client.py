"""A CANopen master that knows CiA 302-3 and nothing of coboot, against one device.

It uses python-canopen and python-can as they come from the package index, and reads the block file
by itself (SYS TEC manual L-1112d_10, chapter 3 figure 2), with zlib's CRC. It goes the manual's way
("Prinzipieller Ablauf"): identify, clear, one segmented SDO download per block, status after each,
compare the CRC, sign, start. One line per step; ends with 0 when all went well, else with 1.

    canopen_client.py 127.0.0.1:29536 app.blk
    canopen_client.py slcan:/dev/ttyACM0 app.blk
"""

import argparse
import struct
import sys
import time
import zlib

import can
import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, ObjectDictionary
from canopen.objectdictionary import datatypes as types
from canopen.sdo.exceptions import SdoError

# 1000h of the bootloader (manual, "Prinzipieller Ablauf", step 2).
DEVICE_TYPE_BOOTLOADER = 0x1000_0000
# Commands of 1F51h (manual, table 2).
START, CLEAR, START_BOOTLOADER, SET_SIGNATURE = 0x01, 0x03, 0x80, 0x83
# Values of 1F57h (manual, table 3); bit 0 is BUSY, bits 16 to 31 are manufacturer-specific.
STATUS = {
    0x00: "OK",
    0x02: "NOVALPROG",
    0x04: "FORMAT",
    0x06: "CRC",
    0x08: "NOTCLEARED",
    0x0A: "WRITE",
    0x0C: "ADDRESS",
    0x0E: "SECURED",
    0x10: "NVDATA",
    0x7E: "UNSPECIFIED",
    0x80: "WRONG VID",
    0x82: "WRONG PID",
    0x84: "NO ACCESS",
    0x86: "MAN BUSY",
    0x88: "SEQUENCE",
}
LAST_BLOCK = 0xFFFF_FFFF


class Failed(Exception):
    """A step failed."""


def step(text):
    print(text, flush=True)


def read_blocks(path):
    """The blocks of a file as (number, address, data, whole block), every CRC checked."""
    with open(path, "rb") as file:
        content = file.read()
    blocks = []
    at = 0
    while at < len(content):
        if len(content) - at < 16:
            raise Failed(f"{path}: {len(content) - at} bytes at offset {at} are no block")
        number, address, size = struct.unpack_from("<3L", content, at)
        end = at + 12 + size + 4
        if end > len(content):
            raise Failed(f"{path}: block {number:#x} at offset {at} is cut off")
        (crc,) = struct.unpack_from("<L", content, end - 4)
        if crc != zlib.crc32(content[at : end - 4]):
            raise Failed(f"{path}: wrong CRC of block {number:#x} at offset {at}")
        blocks.append((number, address, content[at + 12 : end - 4], content[at:end]))
        at = end
    numbers = [number for number, *_ in blocks]
    if len(blocks) < 3 or numbers != [*range(len(blocks) - 1), LAST_BLOCK]:
        raise Failed(f"{path}: the blocks are not numbered 0, 1, ..., FFFFFFFFh")
    return blocks


def program_of(blocks):
    """Size and CRC of the program, from the last block and from the data; both must agree."""
    size, crc = struct.unpack("<2L", blocks[-1][2])
    base = blocks[1][1]
    image = bytearray(b"\xff" * size)
    for number, address, data, _ in blocks[1:-1]:
        if address < base or address - base + len(data) > size:
            raise Failed(f"block {number} lies outside the program's {size} bytes")
        image[address - base : address - base + len(data)] = data
    if zlib.crc32(image) != crc:
        raise Failed(f"the program's CRC is {zlib.crc32(image):08X}h, its last block says {crc:08X}h")
    return size, crc


def variable(parent, name, index, subindex=0, data_type=types.UNSIGNED32):
    entry = ODVariable(name, index, subindex)
    entry.data_type = data_type
    if parent is not None:
        parent.add_member(entry)
    return entry


def object_dictionary():
    """The objects of any device for a CiA 302-3 master: 1000h, 1018h, 1F50h, 1F51h, 1F56h, 1F57h."""
    dictionary = ObjectDictionary()
    dictionary.add_object(variable(None, "Device type", 0x1000))
    identity = ODRecord("Identity object", 0x1018)
    variable(identity, "Number of entries", 0x1018, 0, types.UNSIGNED8)
    for subindex, name in enumerate(("Vendor-ID", "Product code", "Revision number", "Serial number"), 1):
        variable(identity, name, 0x1018, subindex)
    dictionary.add_object(identity)
    for index, name, data_type in (
        (0x1F50, "Program data", types.DOMAIN),
        (0x1F51, "Program control", types.UNSIGNED8),
        (0x1F56, "Program software identification", types.UNSIGNED32),
        (0x1F57, "Flash status identification", types.UNSIGNED32),
    ):
        array = ODArray(name, index)
        variable(array, "Number of entries", index, 0, types.UNSIGNED8)
        variable(array, f"{name} 1", index, 1, data_type)
        dictionary.add_object(array)
    return dictionary


class Device:
    """The device under test, through python-canopen."""

    def __init__(self, node, patience):
        self.sdo = node.sdo
        self.patience = patience

    def device_type(self):
        return self.sdo[0x1000].raw

    def wait_until_idle(self, doing):
        """Reads 1F57h until it is not busy. Only OK is a success."""
        give_up = time.monotonic() + self.patience
        while True:
            status = self.sdo[0x1F57][1].raw
            if status & 1 == 0:
                break
            if time.monotonic() > give_up:
                raise Failed(f"{doing}: still busy (1F57h = {status:08X}h)")
            time.sleep(0.01)
        code = status & 0xFFFF
        if code != 0:
            raise Failed(f"{doing}: 1F57h = {status:08X}h ({STATUS.get(code, 'not in the manual')})")

    def command(self, value, doing):
        self.sdo[0x1F51][1].raw = value
        self.wait_until_idle(doing)

    def wait_for(self, wanted, doing):
        """Reads 1000h until `wanted` is true for it; the device may be unreachable meanwhile."""
        give_up = time.monotonic() + self.patience
        while True:
            try:
                device_type = self.device_type()
                if wanted(device_type):
                    return device_type
                problem = f"1000h = {device_type:08X}h"
            except SdoError as error:
                problem = str(error)
            if time.monotonic() > give_up:
                raise Failed(f"{doing}: {problem}")
            time.sleep(0.05)


def identify(device):
    device_type = device.device_type()
    step(f"1000h device type = {device_type:08X}h")
    identity = device.sdo[0x1018]
    entries = identity[0].raw
    if entries != 4:
        raise Failed(f"1018h/0 = {entries}, four entries are expected")
    values = [identity[subindex].raw for subindex in range(1, 5)]
    step("1018h vendor %08Xh, product %08Xh, revision %08Xh, serial %08Xh" % tuple(values))
    step(f"1F57h flash status = {device.sdo[0x1F57][1].raw:08X}h")
    return device_type


def flash(device, blocks, start):
    size, crc = program_of(blocks)
    if identify(device) != DEVICE_TYPE_BOOTLOADER:
        device.sdo[0x1F51][1].raw = START_BOOTLOADER
        device.wait_for(lambda value: value == DEVICE_TYPE_BOOTLOADER, "call back into the bootloader")
        step("called back into the bootloader")

    device.command(CLEAR, "clear")
    step("cleared")
    for number, address, data, block in blocks:
        device.sdo[0x1F50][1].raw = block
        device.wait_until_idle(f"block {number:#x}")
        step(f"block {number:X}h: {len(data)} bytes at {address:08X}h")
    reported = device.sdo[0x1F56][1].raw
    if reported != crc:
        raise Failed(f"1F56h = {reported:08X}h, the program's CRC is {crc:08X}h")
    step(f"1F56h software identification = {reported:08X}h, as the {size} bytes sent")
    device.command(SET_SIGNATURE, "sign")
    step("signed")
    if not start:
        return
    device.sdo[0x1F51][1].raw = START
    device_type = device.wait_for(lambda value: value != DEVICE_TYPE_BOOTLOADER, "start")
    step(f"started: 1000h device type = {device_type:08X}h")
    control, reported = device.sdo[0x1F51][1].raw, device.sdo[0x1F56][1].raw
    if (control, reported) != (1, crc):
        raise Failed(f"the application says 1F51h = {control:02X}h, 1F56h = {reported:08X}h; 01h, {crc:08X}h expected")
    step("the application reports 1F51h = 01h and the same 1F56h")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", metavar="HOST:PORT", help="a socketcand server, or slcan:SERIAL-PORT")
    parser.add_argument("block_file", nargs="?", help="the program; without it the device is only identified")
    parser.add_argument("--channel", default="can0", help="the server's name for the bus (can0)")
    parser.add_argument("--node", type=lambda text: int(text, 0), default=1, help="node-ID (1)")
    parser.add_argument("--timeout", type=float, default=2.0, help="seconds that an SDO answer may take (2)")
    parser.add_argument("--patience", type=float, default=120.0, help="seconds that a step may take (120)")
    parser.add_argument("--no-start", action="store_true", help="leaves the program signed, but not started")
    options = parser.parse_args()
    host, colon, port = options.endpoint.rpartition(":")
    if host == "slcan":
        # The bit rate of the bus behind it does not matter. The default pause after opening is for
        # boards that reset when they are opened.
        bus = {"interface": "slcan", "channel": port, "bitrate": 125_000, "sleep_after_open": 0.1}
    elif colon and port.isdecimal():
        # tcp_tune sets TCP_NODELAY; without it every answer waits for the kernel's delayed ACK.
        bus = {"interface": "socketcand", "host": host, "port": int(port), "channel": options.channel, "tcp_tune": True}
    else:
        parser.error(f"{options.endpoint} is not HOST:PORT")

    network = canopen.Network()
    try:
        blocks = read_blocks(options.block_file) if options.block_file else None
        network.connect(**bus)
        node = network.add_node(options.node, object_dictionary())
        node.sdo.RESPONSE_TIMEOUT = options.timeout
        device = Device(node, options.patience)
        if blocks:
            flash(device, blocks, not options.no_start)
        else:
            identify(device)
    except (Failed, OSError, struct.error, SdoError, can.CanError) as error:
        step(f"FAILED: {error}")
        return 1
    finally:
        if network.bus is not None:
            network.disconnect()
    step("done")
    return 0


if __name__ == "__main__":
    sys.exit(main())
