"""The orders of public update scripts on python-canopen, in own words, with their time-outs and pauses.

None of them knows coboot, and most of them send no CLEAR. Ends with 0 when the program runs, else with 1.

    script_client.py 127.0.0.1:29536 app.bin ORDER [--slower FACTOR]

The orders: `ixxat` (an ECU behind an IXXAT adapter: by 1F51h, segments, 256 bytes at a time), `mcuboot` (MCUboot
behind CANopenNode: the whole value at once, with the defaults of python-canopen), `ulc` (a C# tool: STOP in any case,
one attempt of 200 ms, then 700 ms for a boot-up), `emotas` (STOP, wait for the boot-up, CLEAR, poll), `ddt` (an
upload of rubbish first, to see it refused), `issue28` (one write of the whole image by block transfer).
"""

import sys
import time
import zlib

import client
from canopen_client import Failed, object_dictionary
from canopen.sdo.exceptions import SdoError
from canopen.nmt import NmtError

STOP, START, CLEAR = b"\x00", b"\x01", b"\x03"
RUNS = b"\x01"
PRE_OPERATIONAL = 128


class Script:
    def __init__(self, node, image, slower):
        self.node, self.sdo, self.image, self.slower = node, node.sdo, image, slower

    def patience(self, timeout, retries):
        self.sdo.RESPONSE_TIMEOUT, self.sdo.MAX_RETRIES = timeout * self.slower, retries

    def sleep(self, seconds):
        time.sleep(seconds * self.slower)

    def control(self, value):
        self.sdo.download(0x1F51, 1, value)

    def runs(self):
        return self.sdo.upload(0x1F51, 1) == RUNS

    def idle(self, pause):
        while self.sdo.upload(0x1F57, 1)[0] & 1:
            self.sleep(pause)

    def write(self, data, pieces=None, **options):
        with self.sdo[0x1F50][1].open("wb", size=len(data), **options) as stream:
            for at in range(0, len(data), pieces or len(data)):
                stream.write(data[at : at + (pieces or len(data))])

    def boot_up(self, seconds):
        try:
            self.node.nmt.wait_for_bootup(seconds * self.slower)
        except NmtError:
            pass  # It came before the answer.

    def ixxat(self):
        self.patience(1, 5)
        self.node.nmt.send_command(PRE_OPERATIONAL)
        if self.runs():
            self.control(STOP)
            self.sleep(2)
        self.write(self.image, 256, block_transfer=False)
        self.control(START)

    def mcuboot(self):
        self.patience(0.3, 1)
        self.sdo.upload(0x100A, 0)
        self.control(STOP)
        self.sdo[0x1F50][1].raw = self.image
        self.control(START)

    def ulc(self):
        self.patience(0.2, 0)
        try:
            self.control(STOP)
        except SdoError:
            pass
        self.boot_up(0.7)
        self.sleep(0.5)
        self.patience(5, 0)
        self.write(self.image)
        self.control(START)

    def emotas(self):
        self.patience(2, 1)
        if self.runs():
            self.control(STOP)
            self.boot_up(0.5)
        self.control(CLEAR)
        self.sleep(0.25)
        self.idle(1)
        self.sdo.download(0x1F50, 1, self.image, force_segment=True)
        self.sleep(2)
        self.idle(0.1)
        self.control(START)

    def ddt(self):
        self.patience(1, 1)
        try:
            self.write(bytes(range(183)), block_transfer=True)
            raise Failed("rubbish was taken")
        except SdoError:
            pass
        if self.runs():
            self.control(STOP)
            self.sleep(1)
        self.write(self.image, block_transfer=False)
        self.control(START)

    def issue28(self):
        self.patience(1, 1)
        if self.runs():
            self.control(STOP)
            self.sleep(0.5)
        self.write(self.image, block_transfer=True)
        self.control(START)

    def check(self):
        self.patience(1, 5)
        for _ in range(20):
            self.sleep(0.1)
            try:
                if self.runs():
                    break
            except SdoError:
                pass
        found = int.from_bytes(self.sdo.upload(0x1F56, 1), "little")
        if not self.runs() or found != zlib.crc32(self.image):
            raise Failed(f"1F51h does not read 1, or 1F56h = {found:08X}h is another program")
        print("it runs")


def main():
    parser = client.arguments(__doc__)
    parser.add_argument("image", help="a raw image, from the start of the program on")
    parser.add_argument("order", choices=["ixxat", "mcuboot", "ulc", "emotas", "ddt", "issue28"])
    parser.add_argument("--slower", type=float, default=1, help="the device is slower by this factor")
    options = parser.parse_args()

    def act(node):
        script = Script(node, client.read(options.image), options.slower)
        getattr(script, options.order)()
        script.check()

    return client.run(options.address, act, dictionary=object_dictionary())


if __name__ == "__main__":
    sys.exit(main())
