"""A CANopen master as CiA 302-2 and 302-3 describe it, which has a raw image and knows no block files.

It uses python-canopen and python-can as they come from the package index. Boot slave with a program
update: read 1000h and 1018h, compare 1F56h; stop, clear, one SDO download of the whole image, wait for
1F57h, compare 1F56h; start; 1F51h reads 1, and 1F56h is the same in the application. One line per step;
ends with 0 when all went well, else with 1.

    image_client.py 127.0.0.1:29536 app.bin [--block]
"""

import sys
import zlib

import client
from canopen_client import Device, Failed, object_dictionary, step

# Values of 1F51h (CiA 302-3).
STOP, START, CLEAR = 0, 1, 3
STOPPED, STARTED, NO_PROGRAM = 0, 1, 3


def update(device, image, block):
    crc = zlib.crc32(image)
    control = device.sdo[0x1F51][1]
    step(f"1000h device type = {device.device_type():08X}h")
    if device.sdo[0x1F56][1].raw == crc:
        raise Failed("the program is there already")
    if control.raw == STARTED:
        control.raw = STOP
        device.wait_for(lambda _: control.raw == STOPPED, "stop")
        step("stopped")
    device.command(CLEAR, "clear")
    step("cleared")
    # Like any master, it sends the data as fast as they are acknowledged.
    options = {"block_transfer": True} if block else {}
    with device.sdo[0x1F50][1].open("wb", size=len(image), buffering=1024, **options) as stream:
        stream.write(image)
    device.wait_until_idle("download")
    step(f"{len(image)} bytes sent " + ("in blocks" if block else "in segments"))
    reported = device.sdo[0x1F56][1].raw
    if reported != crc:
        raise Failed(f"1F56h = {reported:08X}h, the image's CRC is {crc:08X}h")
    if control.raw != STOPPED:
        raise Failed(f"1F51h = {control.raw}, the program is there and stopped")
    control.raw = START
    device.wait_for(lambda _: control.raw == STARTED, "start")
    reported = device.sdo[0x1F56][1].raw
    if reported != crc:
        raise Failed(f"1F56h of the application = {reported:08X}h, the image's CRC is {crc:08X}h")
    step("started; 1F56h is the same")


def main():
    parser = client.image_arguments(__doc__, "a raw image, from the start of the program on")
    options = parser.parse_args()
    image = client.read(options.image)
    act = lambda node: update(Device(node, 60.0), image, options.block)
    return client.run(options.address, act, dictionary=object_dictionary())


if __name__ == "__main__":
    sys.exit(main())
