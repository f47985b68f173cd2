"""An unmodified python-canopen that writes a sealed image, and knows nothing of what is in it.

Nothing of the client is set but the SDO time-out, which is on the clock of a machine that may have
other work: tests in virtual time show that no answer takes 5 ms.

    sealed_client.py 127.0.0.1:29536 app.cbs [--block]
"""

import argparse
import sys
import time

import can
import canopen
from canopen.sdo.exceptions import SdoError

# Values of 1F51h (CiA 302-3).
START, CLEAR = 1, 3


def number(node, index):
    return int.from_bytes(node.sdo.upload(index, 1), "little")


def wait_until_idle(node):
    until = time.monotonic() + 60
    while number(node, 0x1F57) & 1:
        if time.monotonic() > until:
            raise OSError("1F57h stays busy")
        time.sleep(0.05)


def update(node, image, block):
    node.sdo.download(0x1F51, 1, bytes([CLEAR]))
    wait_until_idle(node)
    try:
        if block:
            with node.sdo.open(0x1F50, 1, "wb", size=len(image), block_transfer=True) as stream:
                stream.write(image)
        else:
            node.sdo.download(0x1F50, 1, image)
    except SdoError as error:
        print(f"the transfer ended: {error}", flush=True)
    wait_until_idle(node)
    status = number(node, 0x1F57)
    print(f"1F57h = {status:08X}h, 1F56h = {number(node, 0x1F56):08X}h", flush=True)
    if status == 0:
        node.sdo.download(0x1F51, 1, bytes([START]))
        node.nmt.wait_for_bootup(5)
        print("started", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("address", help="HOST:PORT of the socketcand server")
    parser.add_argument("image", help="a sealed image")
    parser.add_argument("--block", action="store_true", help="by SDO block transfer")
    arguments = parser.parse_args()
    with open(arguments.image, "rb") as file:
        image = file.read()
    host, port = arguments.address.rsplit(":", 1)
    network = canopen.Network()
    try:
        network.connect(interface="socketcand", host=host, port=int(port), channel="can0", tcp_tune=True)
        node = network.add_node(1)
        node.sdo.RESPONSE_TIMEOUT = 2.0
        update(node, image, arguments.block)
    except (SdoError, can.CanError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    finally:
        network.disconnect()
    return 0


if __name__ == "__main__":
    sys.exit(main())
