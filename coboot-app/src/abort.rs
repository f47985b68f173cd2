//! Why an SDO transfer ends early.

/// The code of an SDO abort (CiA 301 table 22): the codes that this crate uses.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Abort(pub u32);

impl Abort {
    /// The toggle bit of a segment is not alternated.
    pub const TOGGLE: Self = Self(0x0503_0000);
    /// Command specifier not valid or unknown.
    pub const COMMAND: Self = Self(0x0504_0001);
    /// Attempt to write a read-only object.
    pub const READ_ONLY: Self = Self(0x0601_0002);
    /// The object does not exist.
    pub const NO_OBJECT: Self = Self(0x0602_0000);
    /// Access failed due to a hardware error: the bootloader could not store the value.
    pub const HARDWARE: Self = Self(0x0606_0000);
    /// The value is too long.
    pub const LENGTH_TOO_HIGH: Self = Self(0x0607_0012);
    /// The value is too short.
    pub const LENGTH_TOO_LOW: Self = Self(0x0607_0013);
    /// The sub-index does not exist.
    pub const NO_SUB_INDEX: Self = Self(0x0609_0011);
    /// The value is outside the range of the object.
    pub const INVALID_VALUE: Self = Self(0x0609_0030);
    /// The request is not possible in the present state of the device.
    pub const DEVICE_STATE: Self = Self(0x0800_0022);
}

impl core::fmt::Debug for Abort {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "Abort({:08X}h)", self.0)
    }
}

#[cfg(feature = "canopen")]
impl From<Abort> for canopen::AbortCode {
    fn from(Abort(code): Abort) -> Self {
        Self(code)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::Abort;

    /// As the manuals write it.
    #[test]
    fn an_abort_is_shown_as_its_code() {
        assert_eq!(std::format!("{:?}", Abort::NO_SUB_INDEX), "Abort(06090011h)");
    }
}
