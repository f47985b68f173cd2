"""A CANopen master that knows CiA 301 and CiA 305, on a bus of several devices.

python-canopen and python-can as they come from the package index. Two things to do, each a run of its own:

    master_client.py HOST:PORT commission 10 11 12 [--refused-bit-rate 1]
        finds the devices without a node-ID by LSS fastscan, gives them these IDs and 250 kbit/s, stores both

    master_client.py HOST:PORT use app.blk 10 11 12 --device-name NAME
        NMT, heartbeat, emergencies; SDO expedited, segmented and by blocks in both directions; the last device
        gets the program, while the others go on

One line per step; ends with 0 when all went well, else with 1.
"""

import argparse
import queue
import sys
import time

import can
import canopen
from canopen import lss
from canopen.emcy import EmcyError
from canopen.sdo.exceptions import SdoAbortedError, SdoError
from canopen_client import (
    CLEAR,
    DEVICE_TYPE_BOOTLOADER,
    SET_SIGNATURE,
    START,
    Device,
    Failed,
    object_dictionary,
    program_of,
    read_blocks,
    step,
)

# Index in the table of bit rates (CiA 305, table 1).
RATE_250K = 3
UNCONFIGURED = 255
# The states in a heartbeat (CiA 301, table 37).
BOOT_UP, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x05, 0x7F
# Abort codes (CiA 301, table 22).
WRITE_ONLY, READ_ONLY, NO_OBJECT, NOT_STORED = 0x0601_0001, 0x0601_0002, 0x0602_0000, 0x0800_0020
# Emergencies (CiA 301, table 26): wrong data set, device specific; and bits 0 and 7 of the error
# register.
DATA_SET, DEVICE_SPECIFIC, ERROR_RESET = 0x6300, 0xFF00, 0x0000
GENERIC, MANUFACTURER = 0x01, 0x80
# The emergency after boot-up: a bootloader, and the reason why it stays (docs/protocol.md: 6 is "no
# program").
NO_PROGRAM_TO_START = b"BOOT\x06"
CRC_STATUS = 0x06


def expect(what, found, wanted):
    if found != wanted:
        raise Failed(f"{what}: {found!r}, {wanted!r} expected")


def refused_by_lss(doing):
    """The text of the refusal, None if there is none."""
    try:
        doing()
    except lss.LssError as error:
        return str(error)
    return None


def abort_of(doing):
    """The abort code that `doing` causes, None for none."""
    try:
        doing()
    except SdoAbortedError as error:
        return error.code
    return None


# ---------------------------------------------------------------------------------------------------------------------


def inquire(master):
    """The LSS address of the only slave in configuration state."""
    return [
        master.inquire_lss_address(part)
        for part in (
            lss.CS_INQUIRE_VENDOR_ID,
            lss.CS_INQUIRE_PRODUCT_CODE,
            lss.CS_INQUIRE_REVISION_NUMBER,
            lss.CS_INQUIRE_SERIAL_NUMBER,
        )
    ]


def scan(master, attempts=4):
    """Finds one device without a node-ID, which then is in configuration state.

    A scan takes silence for an answer: a late answer on a busy machine spoils it. So the address
    that it found is
    checked, and a failed scan is repeated with more patience.
    """
    for attempt in range(attempts):
        master.RESPONSE_TIMEOUT = 0.1 * 2**attempt
        try:
            master.send_switch_state_global(master.WAITING_STATE)
            found, identity = master.fast_scan()
            master.RESPONSE_TIMEOUT = 2
            if found and inquire(master) == identity:
                return identity
        except lss.LssError:
            pass
    raise Failed("fastscan finds nobody")


def commission(network, node_ids, refused_bit_rate):
    master = network.lss
    boot_ups = queue.Queue()

    def on_heartbeat(can_id, data, _):
        if data == b"\x00":
            boot_ups.put(can_id - 0x700)

    for node_id in node_ids:
        network.subscribe(0x700 + node_id, on_heartbeat)

    # Is there a device? Three give the same answer at once. (python-canopen leaves the answer in
    # its queue.)
    master.send_identify_non_configured_remote_slave()
    expect("identify non-configured", master.responses.get(timeout=2)[0], lss.CS_IDENTIFY_NON_CONFIGURED_SLAVE)

    identities = []
    for node_id in node_ids:
        identity = scan(master)
        expect("node-ID in force", master.inquire_node_id(), UNCONFIGURED)
        expect("node-ID 128", refused_by_lss(lambda: master.configure_node_id(128)), "LSS Error: 1")
        refused = refused_by_lss(lambda: master.configure_bit_timing(refused_bit_rate))
        expect(f"bit rate of index {refused_bit_rate}", refused, "LSS Error: 1")
        master.configure_node_id(node_id)
        master.configure_bit_timing(RATE_250K)
        master.store_configuration()
        identities.append(identity)
        step("found %08X %08X %08X %08X: node-ID %d" % (*identity, node_id))
        # Back to waiting state: now the device has its node-ID, and boots.
        master.send_switch_state_global(master.WAITING_STATE)
        expect("boot-up", boot_ups.get(timeout=5), node_id)

    master.RESPONSE_TIMEOUT = 1
    expect("fastscan when all are configured", master.fast_scan(), (False, None))
    # Each device answers to its own LSS address, and to no other.
    master.RESPONSE_TIMEOUT = 2
    if not master.send_switch_state_selective(*identities[1]):
        raise Failed("switch state selective")
    expect("node-ID of the one selected", master.inquire_node_id(), node_ids[1])
    master.send_switch_state_global(master.WAITING_STATE)
    vendor, product, revision, serial = identities[2]
    master.send_identify_remote_slave(vendor, product, revision, revision, serial, serial)
    expect("identify remote slave", master.responses.get(timeout=2)[0], lss.CS_IDENTIFY_SLAVE)


# ---------------------------------------------------------------------------------------------------------------------


class Consumer:
    """The messages that a node sends by itself, in their order."""

    def __init__(self, node):
        self.states = queue.Queue()
        self.emergencies = queue.Queue()
        node.nmt.add_heartbeat_callback(self.states.put)
        node.emcy.add_callback(self.emergencies.put)

    def await_state(self, who, wanted):
        """The next heartbeat with this state; 0 is the boot-up."""
        give_up = time.monotonic() + 5
        while time.monotonic() < give_up:
            try:
                if self.states.get(timeout=1) == wanted:
                    return
            except queue.Empty:
                pass
        raise Failed(f"{who}: not in state {wanted:02X}h")

    def expect_state(self, who, wanted):
        """The next two heartbeats; one may have been sent before the master's message."""
        while not self.states.empty():
            self.states.get()
        for _ in range(2):
            expect(f"{who}: state", self.states.get(timeout=5), wanted)

    def emergency(self, who, code, register, data=None):
        try:
            found: EmcyError = self.emergencies.get(timeout=5)
        except queue.Empty:
            raise Failed(f"{who}: no emergency {code:04X}h") from None
        expect(f"{who}: emergency", (found.code, found.register), (code, register))
        if data is not None:
            expect(f"{who}: its detail", bytes(found.data), data)


def upload_by_blocks(sdo, index, subindex):
    with sdo.open(index, subindex, "rb", buffering=0, block_transfer=True) as stream:
        value = stream.read()
        # python-canopen has compared the CRC, if the device sends one.
        expect(f"{index:04X}h: the device computes a CRC", stream.crc_supported, True)
        expect(f"{index:04X}h: announced size", stream.size, len(value))
    return value


def download_by_blocks(sdo, index, subindex, value):
    with sdo.open(index, subindex, "wb", buffering=0, size=len(value), block_transfer=True) as stream:
        expect("the device checks a CRC", stream.crc_supported, True)
        rest = value
        while rest:
            rest = rest[stream.write(rest) :]


def talk(node, device_name):
    """SDO upload in three ways, and requests that are refused."""
    sdo = node.sdo
    expect("1000h", sdo.upload(0x1000, 0), DEVICE_TYPE_BOOTLOADER.to_bytes(4, "little"))
    expect("1008h, segmented", sdo.upload(0x1008, 0), device_name)
    expect("1008h, by blocks", upload_by_blocks(sdo, 0x1008, 0), device_name)
    expect("1000h, by blocks", upload_by_blocks(sdo, 0x1000, 0), DEVICE_TYPE_BOOTLOADER.to_bytes(4, "little"))
    expect("read of 1F50h", abort_of(lambda: sdo.upload(0x1F50, 1)), WRITE_ONLY)
    expect("block upload of 1F50h", abort_of(lambda: upload_by_blocks(sdo, 0x1F50, 1)), WRITE_ONLY)
    expect("write to 1000h", abort_of(lambda: sdo.download(0x1000, 0, bytes(4))), READ_ONLY)
    expect("block download to 1000h", abort_of(lambda: download_by_blocks(sdo, 0x1000, 0, bytes(9))), READ_ONLY)
    expect("read of 2000h", abort_of(lambda: sdo.upload(0x2000, 0)), NO_OBJECT)


def use(network, path, node_ids, device_name, timeout):
    blocks = read_blocks(path)
    _, crc = program_of(blocks)
    nodes = {node_id: network.add_node(node_id, object_dictionary()) for node_id in node_ids}
    consumers = {node_id: Consumer(node) for node_id, node in nodes.items()}
    for node in nodes.values():
        node.sdo.RESPONSE_TIMEOUT = timeout

    for node_id, node in nodes.items():
        expect(f"{node_id}: heartbeat", node.nmt.wait_for_heartbeat(timeout=5), "PRE-OPERATIONAL")
        talk(node, device_name)
    step("all are in pre-operational state and answer in every way of SDO")

    first, second, last = node_ids
    nodes[first].nmt.state = "RESET COMMUNICATION"
    consumers[first].await_state(first, BOOT_UP)
    nodes[second].nmt.state = "RESET"
    consumers[second].await_state(second, BOOT_UP)
    for node_id in (first, second):
        consumers[node_id].emergency(node_id, DEVICE_SPECIFIC, 0, NO_PROGRAM_TO_START)
    # A bootloader does not become operational.
    nodes[first].nmt.state = "OPERATIONAL"
    consumers[first].expect_state(first, PRE_OPERATIONAL)
    step("NMT resets one node and not the others; each boot-up is followed by its emergency")

    device = Device(nodes[last], patience=60)
    sdo = nodes[last].sdo
    expect(f"{last}: has said nothing", consumers[last].emergencies.qsize(), 0)
    device.command(CLEAR, "clear")

    # Block 0 by segments, the others as blocks; one of them is damaged at first.
    (*_, control), (*_, damaged) = blocks[0], blocks[1]
    sdo.download(0x1F50, 1, control)
    device.wait_until_idle("block 0")
    damaged = damaged[:20] + bytes([damaged[20] ^ 0x10]) + damaged[21:]
    expect("a damaged block", abort_of(lambda: download_by_blocks(sdo, 0x1F50, 1, damaged)), NOT_STORED)
    expect("1F57h", device.sdo[0x1F57][1].raw & 0xFFFF, CRC_STATUS)
    consumers[last].emergency(last, DATA_SET, GENERIC | MANUFACTURER)
    expect("active emergencies", [entry.code for entry in nodes[last].emcy.active], [DATA_SET])
    for number, *_, block in blocks[1:]:
        download_by_blocks(sdo, 0x1F50, 1, block)
        if number == 1:
            # The device erases after the first good block: meanwhile it and all other devices
            # answer.
            talk(nodes[first], device_name)
            for node_id, node in nodes.items():
                expect(f"{node_id}: heartbeat", node.nmt.wait_for_heartbeat(timeout=5), "PRE-OPERATIONAL")
        device.wait_until_idle(f"block {number:X}h")
    consumers[last].emergency(last, ERROR_RESET, 0)
    expect("active emergencies", nodes[last].emcy.active, [])
    expect("1F56h", device.sdo[0x1F56][1].raw, crc)
    step("a damaged block was refused and told by an emergency, the good ones were taken, and nobody was silent")

    device.command(SET_SIGNATURE, "sign")
    sdo.download(0x1F51, 1, bytes([START]))
    consumers[last].await_state(last, BOOT_UP)
    device.wait_for(lambda value: value != DEVICE_TYPE_BOOTLOADER, "start")
    expect("the application's 1F56h", device.sdo[0x1F56][1].raw, crc)
    expect("the application's 1008h, by blocks", upload_by_blocks(sdo, 0x1008, 0), device_name)
    # An application follows the NMT master.
    nodes[last].nmt.state = "OPERATIONAL"
    consumers[last].await_state(last, OPERATIONAL)
    step("started, and operational when told so")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", metavar="HOST:PORT", help="a socketcand server")
    parser.add_argument("--channel", default="can0", help="the server's name for the bus (can0)")
    parser.add_argument("--timeout", type=float, default=2.0, help="seconds that an SDO answer may take (2)")
    what = parser.add_subparsers(dest="what", required=True)
    commissioning = what.add_parser("commission")
    using = what.add_parser("use")
    using.add_argument("block_file")
    commissioning.add_argument(
        "--refused-bit-rate",
        type=int,
        default=10,
        help="index of a bit rate (CiA 305, table 1) that the device's clock cannot make (10, which is nobody's)",
    )
    using.add_argument("--device-name", required=True, help="what 1008h reads")
    for command in (commissioning, using):
        command.add_argument("node_ids", type=int, nargs=3)
    options = parser.parse_args()
    host, _, port = options.endpoint.rpartition(":")

    network = canopen.Network()
    try:
        network.connect(interface="socketcand", host=host, port=int(port), channel=options.channel, tcp_tune=True)
        if options.what == "commission":
            commission(network, options.node_ids, options.refused_bit_rate)
        else:
            name = options.device_name.encode("ascii")
            use(network, options.block_file, options.node_ids, name, options.timeout)
    except (Failed, OSError, queue.Empty, SdoError, lss.LssError, canopen.nmt.NmtError, can.CanError) as error:
        step(f"FAILED: {error!r}")
        return 1
    finally:
        if network.bus is not None:
            network.disconnect()
    step("done")
    return 0


if __name__ == "__main__":
    sys.exit(main())
