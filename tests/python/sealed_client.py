"""An unmodified python-canopen that writes a sealed image, and knows nothing of what is in it.

    sealed_client.py 127.0.0.1:29536 app.cbs [--block] [--as-it-comes FACTOR]
"""

import sys

from canopen.sdo import SdoClient
from canopen.sdo.exceptions import SdoError

import client
from canopen_client import CLEAR, START, Device, object_dictionary, step

# The value of 1F51h while the program runs (CiA 302-3).
STARTED = 1


def update(device, image, block):
    device.command(CLEAR, "clear")
    try:
        if block:
            with device.sdo.open(0x1F50, 1, "wb", size=len(image), block_transfer=True) as stream:
                stream.write(image)
        else:
            device.sdo.download(0x1F50, 1, image)
    except SdoError as error:
        step(f"the transfer ended: {error}")
    device.wait_until_idle("download")
    control = device.sdo[0x1F51][1]
    control.raw = START
    device.wait_for(lambda _: control.raw == STARTED, "start")
    step("started")


def main():
    parser = client.image_arguments(__doc__, "a sealed image")
    parser.add_argument(
        "--as-it-comes",
        type=int,
        metavar="FACTOR",
        help="with the library's own SDO time-out, for a device that is so many times slower than real time",
    )
    options = parser.parse_args()
    image = client.read(options.image)
    act = lambda node: update(Device(node, 60.0), image, options.block)
    factor = options.as_it_comes
    timeout = factor * SdoClient.RESPONSE_TIMEOUT if factor else 2.0
    return client.run(options.address, act, dictionary=object_dictionary(), timeout=timeout)


if __name__ == "__main__":
    sys.exit(main())
