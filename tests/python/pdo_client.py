"""A master that knows of the application template what its EDS file says: one TPDO, one RPDO and SYNC.

python-canopen reads the PDOs' parameters, exchanges values by them, and changes mapping and transmission
type by its own procedure. One line per step; ends with 0 when all went well, else with 1.

    pdo_client.py 127.0.0.1:29536 docs/eds/coboot-application.eds
"""

import sys
import time

import can
import canopen

from canopen.sdo.exceptions import SdoAbortedError

from canopen_client import Failed, step
from client import arguments, run

# CiA 301 tables 22 and 26.
DEVICE_STATE, RPDO_TOO_SHORT = 0x0800_0022, 0x8210
# Whether and how the machine moves (app-template/src/process.rs).
STANDS, MOVES = 0, 1
PATIENCE = 5.0


def expect(what, got, expected):
    if got != expected:
        raise Failed(f"{what}: {got}, not {expected}")


def values(pdo):
    return {variable.name: variable.raw for variable in pdo}


def receive(pdo, what, **expected):
    """Waits for the TPDO with these values; others may come before it."""
    give_up = time.monotonic() + PATIENCE
    wanted = {name.replace("_", " "): value for name, value in expected.items()}
    while values(pdo) != wanted:
        if time.monotonic() > give_up:
            raise Failed(f"{what}: {values(pdo)}, not {wanted}")
        pdo.wait_for_reception(0.2)
    step(f"{what}: {wanted}")


def act(node):
    network = node.network
    node.tpdo.read()
    node.rpdo.read()
    sent, taken = node.tpdo[1], node.rpdo[1]
    expect("TPDO 1", (sent.cob_id, sent.enabled, sent.rtr_allowed), (0x180 + node.id, True, False))
    expect("RPDO 1", (taken.cob_id, taken.enabled), (0x200 + node.id, True))
    expect("mapping", (sorted(values(sent)), sorted(values(taken))), (["Actual value", "State"], ["Command", "Setpoint"]))
    step("the PDOs are those of the EDS")

    node.nmt.send_command(0x01)
    receive(sent, "started", State=STANDS, Actual_value=0)
    taken["Command"].raw, taken["Setpoint"].raw = 1, 1500
    taken.transmit()
    receive(sent, "moves", State=MOVES, Actual_value=1500)

    # What the RPDO has started keeps the device from leaving.
    try:
        node.sdo[0x1F51][1].raw = 0x80
        raise Failed("80h is acknowledged while the machine moves")
    except SdoAbortedError as error:
        expect("80h while it moves", error.code, DEVICE_STATE)
    step("80h is refused while the machine moves")

    # An identifier of 29 bits and a frame that is too short have no effect.
    for message in (
        can.Message(arbitration_id=taken.cob_id, is_extended_id=True, data=[0, 0, 0]),
        can.Message(arbitration_id=taken.cob_id, is_extended_id=False, data=[0, 0]),
    ):
        network.bus.send(message)
    give_up = time.monotonic() + PATIENCE
    while RPDO_TOO_SHORT not in [emergency.code for emergency in node.emcy.log]:
        if time.monotonic() > give_up:
            raise Failed("no emergency 8210h after an RPDO of two bytes")
        time.sleep(0.01)
    expect("after bad frames", (node.sdo["State"].raw, node.sdo["Setpoint"].raw), (MOVES, 1500))
    step("an RPDO of two bytes: emergency 8210h, and no effect")

    # Both by SYNC, on other COB-IDs, the TPDO with another mapping.
    sent.clear()
    sent.add_variable("Setpoint")
    sent.trans_type, sent.cob_id = 2, 0x1F0
    sent.save()
    sent.subscribe()
    taken.trans_type, taken.cob_id = 0, 0x1F1
    taken.save()
    taken["Command"].raw, taken["Setpoint"].raw = 1, 700
    taken.transmit()
    expect("before SYNC", node.sdo["Setpoint"].raw, 1500)
    for _ in range(2):
        network.sync.transmit()
    receive(sent, "after the second SYNC", Setpoint=700)

    # PRE-OPERATIONAL: no PDO, and the machine stands.
    node.nmt.send_command(0x80)
    expect("in PRE-OPERATIONAL", node.sdo["State"].raw, STANDS)
    node.sdo[0x1F51][1].raw = 0x80
    step("80h is acknowledged when it stands")


def main():
    parser = arguments(__doc__)
    parser.add_argument("eds", help="the EDS file of the application")
    options = parser.parse_args()
    return run(options.address, act, dictionary=canopen.import_od(options.eds, 1))


if __name__ == "__main__":
    sys.exit(main())
