//! What a device says it is: 1000h.

use std::fmt;

use canopen::program::{BOOTLOADER_DEVICE_TYPE, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE};
use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

/// What 1000h reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceType(pub u32);

impl DeviceType {
    /// Whether it is that of a bootloader, of one dialect or the other; everything else is an
    /// application's.
    #[must_use]
    pub const fn is_bootloader(self) -> bool {
        matches!(self.0, BOOTLOADER_DEVICE_TYPE | LIFT_DEVICE_TYPE | ESACADEMY_DEVICE_TYPE)
    }
}

impl fmt::Display for DeviceType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let who = if self.is_bootloader() { "the bootloader" } else { "an application" };
        write!(f, "{who} (device type {:08X}h)", self.0)
    }
}

impl Serialize for DeviceType {
    /// `device_type`, and whether it is a `bootloader`.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serializer.serialize_struct("DeviceType", 2)?;
        fields.serialize_field("device_type", &self.0)?;
        fields.serialize_field("bootloader", &self.is_bootloader())?;
        fields.end()
    }
}
