"""Reads objects of one device by SDO block upload, as python-canopen does it, and once more in segments.

It uses python-canopen and python-can as they come from the package index. One line per object; ends with 0
when both ways gave the same, else with 1.

    block_upload_client.py 127.0.0.1:29536 1
"""

import sys

import client
from canopen_client import Failed, step

# Mandatory objects, the texts of the device, and the program objects of CiA 302-3.
OBJECTS = [(0x1000, 0), (0x1008, 0), (0x1009, 0), (0x100A, 0), (0x1018, 0), (0x1018, 1), (0x1018, 4)]
OBJECTS += [(0x1F51, 1), (0x1F56, 1), (0x1F57, 1)]


def read(node, index, subindex, block):
    # Without a buffer, so that the device's bytes are compared unchanged.
    with node.sdo.open(index, subindex, "rb", buffering=0, block_transfer=block) as stream:
        data = b""
        while True:
            part = stream.read(7)
            if not part:
                return data
            data += part


def compare(node):
    for index, subindex in OBJECTS:
        by_block = read(node, index, subindex, True)
        in_segments = node.sdo.upload(index, subindex)
        step(f"{index:04X}h/{subindex}: {by_block.hex()}")
        if by_block != in_segments:
            raise Failed(f"in segments it is {in_segments.hex()}")


def main():
    parser = client.arguments(__doc__)
    parser.add_argument("node", type=int)
    options = parser.parse_args()
    return client.run(options.address, compare, options.node)


if __name__ == "__main__":
    sys.exit(main())
