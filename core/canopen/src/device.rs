//! The objects that every device has: device type, names and versions, identity.
//!
//! A device adds [`ENTRIES`] to its [`Table`](crate::od::Table) and calls [`Device::read`] before
//! it looks at its other objects.

use crate::abort::AbortCode;
use crate::lss::LssAddress;
use crate::od::{put, Access, Address, DataType, Entry};
use crate::program::{
    DEVICE_NAME, DEVICE_TYPE, ERROR_REGISTER, HARDWARE_VERSION, HEARTBEAT_TIME, IDENTITY, SOFTWARE_VERSION,
};

/// 1000h, 1001h, 1008h–100Ah, 1017h, 1018h/0–4 (CiA 301 clause 7.5.2).
pub const ENTRIES: [Entry; 11] = [
    Entry::var(DEVICE_TYPE, "Device type", DataType::Unsigned32, Access::Const),
    Entry::var(ERROR_REGISTER, "Error register", DataType::Unsigned8, Access::Ro).default(0),
    Entry::var(DEVICE_NAME, "Manufacturer device name", DataType::VisibleString, Access::Const),
    Entry::var(HARDWARE_VERSION, "Manufacturer hardware version", DataType::VisibleString, Access::Const),
    Entry::var(SOFTWARE_VERSION, "Manufacturer software version", DataType::VisibleString, Access::Const),
    Entry::var(HEARTBEAT_TIME, "Producer heartbeat time", DataType::Unsigned16, Access::Const),
    Entry::record(IDENTITY, "Identity object", 4),
    Entry::sub(IDENTITY, 1, "Vendor-ID", DataType::Unsigned32, Access::Const),
    Entry::sub(IDENTITY, 2, "Product code", DataType::Unsigned32, Access::Const),
    Entry::sub(IDENTITY, 3, "Revision number", DataType::Unsigned32, Access::Const),
    Entry::sub(IDENTITY, 4, "Serial number", DataType::Unsigned32, Access::Const),
];

/// The values of these objects.
#[derive(Clone, Copy, Debug)]
pub struct Device {
    /// 1000h.
    pub device_type: u32,
    /// 1008h.
    pub name: &'static str,
    /// 1009h.
    pub hardware_version: &'static str,
    /// 100Ah.
    pub software_version: &'static str,
    /// 1017h, in milliseconds; 0 for no heartbeat.
    pub heartbeat_ms: u16,
    /// 1018h/1.
    pub vendor_id: u32,
    /// 1018h/2.
    pub product_code: u32,
    /// 1018h/3: major in the upper half, minor in the lower.
    pub revision: u32,
    /// 1018h/4.
    pub serial_number: u32,
}

impl Device {
    /// The address of the device for layer setting services.
    #[must_use]
    pub const fn lss_address(&self) -> LssAddress {
        LssAddress {
            vendor_id: self.vendor_id,
            product_code: self.product_code,
            revision: self.revision,
            serial_number: self.serial_number,
        }
    }

    /// Reads one of [`ENTRIES`]; `None` for every other address.
    ///
    /// # Errors
    /// [`AbortCode::OUT_OF_MEMORY`] for a text longer than `buf`.
    pub fn read(&self, at: Address, buf: &mut [u8]) -> Option<Result<usize, AbortCode>> {
        let (number, len) = match (at.index, at.sub) {
            (DEVICE_NAME, 0) => return Some(put(buf, self.name.as_bytes())),
            (HARDWARE_VERSION, 0) => return Some(put(buf, self.hardware_version.as_bytes())),
            (SOFTWARE_VERSION, 0) => return Some(put(buf, self.software_version.as_bytes())),
            (DEVICE_TYPE, 0) => (self.device_type, 4),
            (ERROR_REGISTER, 0) => (0, 1),
            (HEARTBEAT_TIME, 0) => (self.heartbeat_ms.into(), 2),
            (IDENTITY, 1) => (self.vendor_id, 4),
            (IDENTITY, 2) => (self.product_code, 4),
            (IDENTITY, 3) => (self.revision, 4),
            (IDENTITY, 4) => (self.serial_number, 4),
            _ => return None,
        };
        Some(put(buf, &number.to_le_bytes()[..len]))
    }
}
