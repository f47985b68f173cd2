//! PCANBasic of PEAK-System: the functions that a classic CAN adapter needs.
//!
//! Signatures and `TPCANMsg` are those of the public header `PCANBasic.h` (PCAN-Basic 4); the
//! library for macOS (PCBUSB) exports the same functions.

use std::ffi::c_void;

use crate::load::library;
use crate::LoadError;

/// The file names of the library, in the order of preference.
#[cfg(windows)]
pub const FILES: &[&str] = &["PCANBasic.dll"];
/// The file names of the library, in the order of preference.
#[cfg(target_os = "macos")]
pub const FILES: &[&str] = &["libPCBUSB.dylib", "/usr/local/lib/libPCBUSB.dylib"];
/// The file names of the library, in the order of preference.
#[cfg(not(any(windows, target_os = "macos")))]
pub const FILES: &[&str] = &["libpcanbasic.so", "libpcanbasic.so.4"];

/// `TPCANMsg`: a frame, an error frame or a status message.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Message {
    /// The identifier.
    pub id: u32,
    /// Bits of `MSGTYPE`.
    pub kind: u8,
    /// The number of valid bytes in `data`; more than 8 only if the library is faulty.
    pub len: u8,
    /// The data.
    pub data: [u8; 8],
}

library! {
    Pcan from FILES,
    unsafe {
        initialize: "CAN_Initialize" = fn(u16, u16, u8, u32, u16) -> u32;
        read: "CAN_Read" = fn(u16, *mut Message, *mut c_void) -> u32;
        write: "CAN_Write" = fn(u16, *mut Message) -> u32;
        get: "CAN_GetValue" = fn(u16, u8, *mut c_void, u32) -> u32;
        set: "CAN_SetValue" = fn(u16, u8, *mut c_void, u32) -> u32;
    }
    safe {
        uninitialize: "CAN_Uninitialize" = fn(channel: u16) -> u32;
        status: "CAN_GetStatus" = fn(channel: u16) -> u32;
    }
}

impl Pcan {
    /// Loads the library.
    ///
    /// # Errors
    /// The library is missing or too old.
    pub fn load() -> Result<Self, LoadError> {
        Self::find()
    }

    /// `CAN_Initialize` of a plug-and-play channel, with the two timing registers of an SJA1000.
    /// Returns a `TPCANStatus`, like all following functions.
    pub fn initialize(&self, channel: u16, btr0btr1: u16) -> u32 {
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.initialize)(channel, btr0btr1, 0, 0, 0) }
    }

    /// `CAN_Read`: returns the oldest message, if the status reports one. Does not wait.
    pub fn read(&self, channel: u16) -> (u32, Message) {
        let mut message = Message::default();
        // SAFETY: the message is a local variable with the layout of the header; the header allows
        // a null time stamp.
        let status = unsafe { (self.read)(channel, &raw mut message, std::ptr::null_mut()) };
        (status, message)
    }

    /// `CAN_Write`. Does not wait.
    pub fn write(&self, channel: u16, mut message: Message) -> u32 {
        // SAFETY: the message is a local variable with the layout of the header.
        unsafe { (self.write)(channel, &raw mut message) }
    }

    /// `CAN_GetValue` of a numeric parameter.
    pub fn number(&self, channel: u16, parameter: u8) -> (u32, u32) {
        let mut value = 0_u32;
        // SAFETY: the buffer is a local variable of the passed length.
        let status = unsafe { (self.get)(channel, parameter, (&raw mut value).cast(), 4) };
        (status, value)
    }

    /// `CAN_SetValue` of a numeric parameter.
    pub fn set_number(&self, channel: u16, parameter: u8, mut value: u32) -> u32 {
        // SAFETY: the buffer is a local variable of the passed length.
        unsafe { (self.set)(channel, parameter, (&raw mut value).cast(), 4) }
    }

    /// `CAN_GetValue` of a text parameter: returns its bytes up to the first zero.
    pub fn text(&self, channel: u16, parameter: u8) -> (u32, Vec<u8>) {
        let mut text = [0_u8; 256];
        // SAFETY: the buffer is a local variable and longer than the passed length.
        let status = unsafe { (self.get)(channel, parameter, text.as_mut_ptr().cast(), 255) };
        (status, text.into_iter().take_while(|byte| *byte != 0).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `TPCANMsg` in the header: DWORD, BYTE, BYTE, BYTE[8], padded to whole DWORDs.
    #[test]
    fn a_message_has_the_headers_layout() {
        use std::mem::{offset_of, size_of};
        assert_eq!(size_of::<Message>(), 16);
        assert_eq!((offset_of!(Message, id), offset_of!(Message, kind)), (0, 4));
        assert_eq!((offset_of!(Message, len), offset_of!(Message, data)), (5, 6));
    }
}
