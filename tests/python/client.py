"""What clients of one emulated device share: arguments, its bus, and how they end.

python-canopen and python-can are used as they come from the package index.
"""

import argparse
import sys

import can
import canopen
from canopen.sdo.exceptions import SdoError

from canopen_client import Failed


def arguments(doc):
    """A parser for a device on this bus; its description is the first paragraph of `doc`."""
    parser = argparse.ArgumentParser(description=doc.split("\n\n")[0])
    parser.add_argument("address", help="HOST:PORT of the socketcand server")
    return parser


def image_arguments(doc, image):
    """The same, with a file that is written to 1F50h."""
    parser = arguments(doc)
    parser.add_argument("image", help=image)
    parser.add_argument("--block", action="store_true", help="by SDO block transfer")
    return parser


def read(path):
    with open(path, "rb") as file:
        return file.read()


def run(address, act, number=1, dictionary=None, timeout=2.0):
    """Calls `act` with a node on the bus; returns the exit code: 0, or 1 after an error.

    The SDO time-out uses the clock of a machine that may have other work: tests in virtual time
    show that no answer takes 5 ms.
    """
    host, port = address.rsplit(":", 1)
    network = canopen.Network()
    try:
        # tcp_tune sets TCP_NODELAY; without it every answer waits for the kernel's delayed ACK.
        network.connect(interface="socketcand", host=host, port=int(port), channel="can0", tcp_tune=True)
        node = network.add_node(number, dictionary)
        node.sdo.RESPONSE_TIMEOUT = timeout
        act(node)
    except (Failed, SdoError, can.CanError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    finally:
        network.disconnect()
    return 0
