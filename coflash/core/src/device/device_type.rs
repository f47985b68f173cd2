//! The device type, 1000h.

use std::fmt;

use canopen::program::{BOOTLOADER_DEVICE_TYPE, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE};
use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

/// The value of 1000h.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceType(pub u32);

impl DeviceType {
    /// Whether this is the device type of a bootloader, of any dialect; every other value belongs
    /// to an application.
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
    /// Writes `device_type`, and `bootloader` if it is the device type of a bootloader.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut fields = serializer.serialize_struct("DeviceType", 2)?;
        fields.serialize_field("device_type", &self.0)?;
        fields.serialize_field("bootloader", &self.is_bootloader())?;
        fields.end()
    }
}
