"""Writes the block files that conversion of program.* must give, from the manual's tables alone (L-1112d_10,
chapter 5.1): blocks of 0x110 bytes as in the manual's example call, and the default of 0x400 bytes."""
import binascii
import re
import struct
import subprocess
import zlib

START = 0x08010000


def crc16(data):
    """Polynomial 1021h, start value 0, as the manual's --crc16 has it."""
    return binascii.crc_hqx(data, 0)


def block(number, address, data, crc):
    body = struct.pack("<III", number, address, len(data)) + data
    return body + struct.pack("<I", crc(body))


def memory():
    """Address -> byte, as GNU objdump shows the load addresses of the sections."""
    text = subprocess.run(["arm-none-eabi-objdump", "-h", "program.elf"], capture_output=True, text=True, check=True)
    image = open("program.elf", "rb").read()
    found = {}
    for line in text.stdout.splitlines():
        match = re.match(r"\s*\d+ \.(vectors|text|far|data)\s+(\w+)\s+\w+\s+(\w+)\s+(\w+)", line)
        if match:
            size, load, offset = (int(field, 16) for field in match.groups()[1:])
            found.update((load + i, image[offset + i]) for i in range(size))
    return found


def last_of_2008(size, crc, reserved):
    """The last block of the older manual (L-1112e_5, 5.1). Its table prints data size 8, a field of 32 reserved bytes,
    and the offsets 28h, 2Ch and 30h for the size and CRC of the program and the CRC of the block. The offsets leave 28
    bytes for the field; with 32 bytes everything after it is 4 bytes later. The data size counts neither."""
    body = struct.pack("<III", 0xFFFFFFFF, 0, 8) + bytes(reserved) + struct.pack("<II", size, crc)
    assert reserved == 32 or (body.find(struct.pack("<I", size), 12), len(body)) == (0x28, 0x30)
    return body + struct.pack("<I", zlib.crc32(body))


def block_file(control, block_size, crc=zlib.crc32, offset=0, reserved=None):
    found = memory()
    flash = bytes(found.get(a, 0xFF) for a in range(START, max(found) + 1))
    assert flash == open("program.bin", "rb").read()
    out, number, address = block(0, 0, control(len(flash)), crc), 1, START
    while any(a >= address for a in found):
        # A block starts at the word of the first byte that is not in a block yet, and ends with its
        # last byte.
        address = min(a for a in found if a >= address) & ~3
        last = max(a for a in found if a < address + block_size - 16)
        out += block(number, address + offset, flash[address - START:last + 1 - START], crc)
        number, address = number + 1, address + block_size - 16
    if reserved is not None:
        return out + last_of_2008(len(flash), crc(flash), reserved)
    return out + block(0xFFFFFFFF, 0, struct.pack("<II", len(flash), crc(flash)), crc)


open("plain-400.blk", "wb").write(block_file(lambda size: bytes(8), 0x400))
open("identity-110.blk", "wb").write(block_file(lambda size: struct.pack("<III", size, 0, 1234), 0x110))
open("release-110.blk", "wb").write(
    block_file(lambda size: struct.pack("<IIIIq", size, 0, 1234, 0x00640A01, 1420070400), 0x110))
open("crc16-400.blk", "wb").write(block_file(lambda size: bytes(8), 0x400, crc16))
open("adjusted-400.blk", "wb").write(block_file(lambda size: bytes(8), 0x400, offset=-0x08000000))
open("last-2008-offsets-400.blk", "wb").write(block_file(lambda size: bytes(8), 0x400, reserved=28))
open("last-2008-reserved-400.blk", "wb").write(block_file(lambda size: bytes(8), 0x400, reserved=32))
