"""A configuration tool that knows of a device what its EDS file says, against the device.

python-canopen imports the file; then every value in it is read over SDO, and compared in access, type and
default. One line per value; ends with 0 when all agree, else with 1.

    eds_client.py 127.0.0.1:29536 docs/eds/coboot-bootloader.eds
"""

import argparse
import sys

import can
import canopen
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary import datatypes as types
from canopen.sdo.exceptions import SdoAbortedError, SdoError

# CiA 301, table 22.
READ_OF_WRITE_ONLY, WRITE_OF_READ_ONLY, NO_DATA = 0x0601_0001, 0x0601_0002, 0x0800_0024
NO_OBJECT, NO_SUB_INDEX = 0x0602_0000, 0x0609_0011
# CiA 301, table 44.
SIZES = {
    types.BOOLEAN: 1,
    types.INTEGER8: 1,
    types.INTEGER16: 2,
    types.INTEGER32: 4,
    types.UNSIGNED8: 1,
    types.UNSIGNED16: 2,
    types.UNSIGNED32: 4,
    types.UNSIGNED64: 8,
}
ERROR_FIELD = 0x1003
IDENTITY = 0x1018


class Differs(Exception):
    """The device differs from the file."""


def values(dictionary):
    """Every value of the file; write-only ones last, since writing them changes other values."""
    found = []
    for entry in dictionary.values():
        found.extend([entry] if isinstance(entry, ODVariable) else entry.values())
    return sorted(found, key=lambda value: value.access_type == "wo")


def read(sdo, value):
    with sdo.open(value.index, value.subindex, "rb", buffering=0) as stream:
        return stream.read()


def abort_of(doing):
    """The abort code that `doing` causes, None for none."""
    try:
        doing()
    except SdoAbortedError as error:
        return error.code
    return None


def shown(code):
    return "no abort" if code is None else f"abort {code:08X}h"


def expect_abort(doing, code, what):
    got = abort_of(doing)
    if got != code:
        raise Differs(f"{what} gives {shown(got)}, not {shown(code)}")


def check_type(value, data):
    size = SIZES.get(value.data_type)
    if size is not None and len(data) != size:
        raise Differs(f"{len(data)} bytes are read, its type has {size}")
    if value.data_type == types.VISIBLE_STRING and not data.decode("ascii").isprintable():
        raise Differs(f"{data!r} is no text")


def check(sdo, value):
    """Compares one value, and returns the result in a few words."""
    if value.access_type == "wo":
        expect_abort(lambda: read(sdo, value), READ_OF_WRITE_ONLY, "reading")
        # A domain accepts only data in its own format; here it matters only that it can be written.
        code = abort_of(lambda: sdo.download(value.index, value.subindex, b"\0"))
        if code in (WRITE_OF_READ_ONLY, NO_OBJECT, NO_SUB_INDEX):
            raise Differs(f"writing gives {shown(code)}")
        return "written only"

    if value.index == ERROR_FIELD and value.subindex > sdo[ERROR_FIELD][0].raw:
        expect_abort(lambda: read(sdo, value), NO_DATA, "reading where no error is")
        expect_abort(lambda: sdo.download(value.index, value.subindex, bytes(4)), WRITE_OF_READ_ONLY, "writing")
        return "no error there"

    data = read(sdo, value)
    check_type(value, data)
    is_value = value.decode_raw(data)
    if value.default is not None and is_value != value.default:
        raise Differs(f"{is_value!r} is read, its default is {value.default!r}")
    if value.access_type == "rw":
        # Writing the present value changes nothing, and must be accepted.
        sdo.download(value.index, value.subindex, data)
    elif value.access_type in ("ro", "const"):
        expect_abort(lambda: sdo.download(value.index, value.subindex, data), WRITE_OF_READ_ONLY, "writing")
    else:
        raise Differs(f"the file gives access {value.access_type!r}, which this client does not know")
    return f"{is_value!r}" + ("" if value.default is None else ", its default")


def check_identity(sdo, information):
    """The file has the identity a second time."""
    for subindex, said in enumerate(
        (information.vendor_number, information.product_number, information.revision_number), 1
    ):
        number = sdo[IDENTITY][subindex].raw
        if number != said:
            raise Differs(f"1018h/{subindex} = {number:08X}h, [DeviceInfo] says {said:08X}h")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", metavar="HOST:PORT", help="a socketcand server")
    parser.add_argument("eds", help="the EDS file")
    parser.add_argument("--channel", default="can0", help="the server's name for the bus (can0)")
    parser.add_argument("--node", type=lambda text: int(text, 0), default=1, help="node-ID (1)")
    options = parser.parse_args()
    host, colon, port = options.endpoint.rpartition(":")
    if not colon or not port.isdecimal():
        parser.error(f"{options.endpoint} is not HOST:PORT")

    network = canopen.Network()
    compared, different = 0, 0
    try:
        dictionary = canopen.import_od(options.eds, options.node)
        network.connect(interface="socketcand", host=host, port=int(port), channel=options.channel, tcp_tune=True)
        sdo = network.add_node(options.node, dictionary).sdo
        sdo.RESPONSE_TIMEOUT = 2.0
        check_identity(sdo, dictionary.device_information)
        for value in values(dictionary):
            compared += 1
            name = f"{value.index:04X}h/{value.subindex} {value.name} ({value.access_type})"
            try:
                print(f"{name}: {check(sdo, value)}")
            except (Differs, SdoError, UnicodeDecodeError) as error:
                different += 1
                print(f"{name}: DIFFERS: {error}")
    except (Differs, OSError, ValueError, SdoError, can.CanError) as error:
        print(f"FAILED: {error}")
        return 1
    finally:
        if network.bus is not None:
            network.disconnect()
    print(f"{compared} values compared, {different} differ")
    return 1 if different or not compared else 0


if __name__ == "__main__":
    sys.exit(main())
