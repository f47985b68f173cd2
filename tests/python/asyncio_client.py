"""canopen-asyncio as a CiA 302-3 master: a raw image into several devices at the same time.

It uses canopen-asyncio and python-can as they come from the package index, without an object dictionary:
adownload and aupload take index and sub-index. One line per step of each device; ends with 0 when all went
well, else with 1.

    asyncio_client.py 127.0.0.1:29536 app.bin 1 [NODE …]
"""

import argparse
import asyncio
import sys
import zlib

import can
import canopen_asyncio as canopen

# Values of 1F51h (CiA 302-3).
STOP, START, CLEAR = 0, 1, 3
STARTED = 1
BUSY = 1


class Failed(Exception):
    """The error of a device."""


async def number(node, index, subindex=1):
    return int.from_bytes(await node.sdo.aupload(index, subindex), "little")


async def until(condition, what):
    """Waits until the condition is true, at most 60 s; a device does not answer while it restarts."""
    for _ in range(600):
        try:
            if await condition():
                return
        except canopen.SdoCommunicationError:
            pass
        await asyncio.sleep(0.1)
    raise Failed(f"no end of: {what}")


async def update(node, image):
    crc = zlib.crc32(image)

    def step(text):
        print(f"node {node.id}: {text}", flush=True)

    async def control():
        return await number(node, 0x1F51)

    async def running():
        return await control() == STARTED

    async def stopped():
        return not await running()

    async def idle():
        return not await number(node, 0x1F57) & BUSY

    async def command(value):
        await node.sdo.adownload(0x1F51, 1, bytes([value]))

    if await running():
        await command(STOP)
        await until(stopped, "stop")
        step("stopped")
    await command(CLEAR)
    await until(idle, "clear")
    step("cleared")
    await node.sdo.adownload(0x1F50, 1, image)
    await until(idle, "download")
    status = await number(node, 0x1F57)
    if status:
        raise Failed(f"1F57h reads {status:08X}h")
    step(f"{len(image)} bytes sent")
    await command(START)
    await until(running, "start")
    reported = await number(node, 0x1F56)
    if reported != crc:
        raise Failed(f"1F56h = {reported:08X}h, the image's CRC is {crc:08X}h")
    step("started; 1F56h is the same")


async def run(arguments):
    with open(arguments.image, "rb") as file:
        image = file.read()
    host, port = arguments.address.rsplit(":", 1)
    network = canopen.Network(loop=asyncio.get_running_loop())
    network.connect(interface="socketcand", host=host, port=int(port), channel="can0", tcp_tune=True)
    try:
        nodes = []
        for number_of_node in arguments.nodes:
            node = await network.aadd_node(number_of_node, canopen.ObjectDictionary())
            node.sdo.RESPONSE_TIMEOUT = 2.0
            nodes.append(node)
        await asyncio.gather(*(update(node, image) for node in nodes))
    finally:
        network.disconnect()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("address", help="HOST:PORT of the socketcand server")
    parser.add_argument("image", help="a raw image, from the start of the program on")
    parser.add_argument("nodes", type=int, nargs="+", help="the node-IDs")
    try:
        asyncio.run(run(parser.parse_args()))
    except (Failed, canopen.SdoAbortedError, canopen.SdoCommunicationError, can.CanError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
