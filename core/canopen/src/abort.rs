//! Why an SDO transfer ends early (CiA 301 table 22).

use core::fmt;

/// The code in an SDO abort. A device may send codes that are not in the table.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct AbortCode(pub u32);

/// Names and texts of the standard's codes, from one list.
macro_rules! abort_codes {
    ($($name:ident = $code:literal, $words:literal;)*) => {
        impl AbortCode {
            $(#[doc = concat!($words, ".")] pub const $name: Self = Self($code);)*
        }

        impl fmt::Display for AbortCode {
            /// The code, and its meaning if CiA 301 gives one.
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                let words = match self.0 {
                    $($code => $words,)*
                    _ => "code of the manufacturer",
                };
                write!(f, "{:08X}h ({words})", self.0)
            }
        }
    };
}

abort_codes! {
    TOGGLE = 0x0503_0000, "toggle bit not alternated";
    TIMEOUT = 0x0504_0000, "SDO protocol timed out";
    COMMAND = 0x0504_0001, "command specifier not valid or unknown";
    BLOCK_SIZE = 0x0504_0002, "invalid block size";
    SEQUENCE_NUMBER = 0x0504_0003, "invalid sequence number";
    CRC = 0x0504_0004, "CRC error";
    OUT_OF_MEMORY = 0x0504_0005, "out of memory";
    UNSUPPORTED_ACCESS = 0x0601_0000, "unsupported access to an object";
    WRITE_ONLY = 0x0601_0001, "attempt to read a write-only object";
    READ_ONLY = 0x0601_0002, "attempt to write a read-only object";
    NO_OBJECT = 0x0602_0000, "object does not exist in the object dictionary";
    NOT_MAPPABLE = 0x0604_0041, "object cannot be mapped to the PDO";
    PDO_LENGTH = 0x0604_0042, "mapped objects would exceed the PDO length";
    PARAMETER = 0x0604_0043, "general parameter incompatibility";
    INTERNAL = 0x0604_0047, "general internal incompatibility in the device";
    HARDWARE = 0x0606_0000, "access failed due to a hardware error";
    LENGTH = 0x0607_0010, "data type or length of service parameter does not match";
    LENGTH_TOO_HIGH = 0x0607_0012, "length of service parameter too high";
    LENGTH_TOO_LOW = 0x0607_0013, "length of service parameter too low";
    NO_SUB_INDEX = 0x0609_0011, "sub-index does not exist";
    INVALID_VALUE = 0x0609_0030, "invalid value for parameter";
    VALUE_TOO_HIGH = 0x0609_0031, "value of parameter written too high";
    VALUE_TOO_LOW = 0x0609_0032, "value of parameter written too low";
    RANGE = 0x0609_0036, "maximum value is less than minimum value";
    RESOURCE = 0x060A_0023, "resource not available: SDO connection";
    GENERAL = 0x0800_0000, "general error";
    STORE = 0x0800_0020, "data cannot be transferred or stored";
    LOCAL_CONTROL = 0x0800_0021, "data cannot be transferred or stored because of local control";
    DEVICE_STATE = 0x0800_0022, "data cannot be transferred or stored in the present device state";
    NO_DICTIONARY = 0x0800_0023, "no object dictionary present or its generation failed";
    NO_DATA = 0x0800_0024, "no data available";
}

impl fmt::Debug for AbortCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "AbortCode({:08X}h)", self.0)
    }
}

impl core::error::Error for AbortCode {}
