//! CANlib of Kvaser: the functions that a classic CAN adapter needs.
//!
//! Signatures are those of the public header `canlib.h` (CANlib 5); `long` has the system's width.

// A conversion that is necessary on one system is useless on another, where `long` has 64 bits.
#![allow(clippy::useless_conversion, clippy::unnecessary_fallible_conversions)]

use std::ffi::{c_int, c_long, c_uint, c_ulong, c_void};

use crate::load::library;
use crate::LoadError;

/// The file names of the library, in the order of preference.
#[cfg(windows)]
pub const FILES: &[&str] = &["canlib32.dll"];
/// The file names of the library, in the order of preference. Kvaser has no library for macOS.
#[cfg(target_os = "macos")]
pub const FILES: &[&str] = &["libcanlib.dylib"];
/// The file names of the library, in the order of preference.
#[cfg(not(any(windows, target_os = "macos")))]
pub const FILES: &[&str] = &["libcanlib.so.1", "libcanlib.so"];

/// A message from `canReadWait`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Message {
    /// The identifier; negative only if the library is faulty.
    pub id: i64,
    /// The number of valid bytes in `data`; more than 8 only if the library is faulty.
    pub len: u32,
    /// Bits of `canMSG_…` and `canMSGERR_…`.
    pub flags: u32,
    /// The data.
    pub data: [u8; 8],
}

library! {
    Canlib from FILES,
    unsafe {
        initialize: "canInitializeLibrary" = fn();
        channels: "canGetNumberOfChannels" = fn(*mut c_int) -> c_int;
        channel_data: "canGetChannelData" = fn(c_int, c_int, *mut c_void, usize) -> c_int;
        bus_parameters: "canSetBusParams" = fn(c_int, c_long, c_uint, c_uint, c_uint, c_uint, c_uint) -> c_int;
        write: "canWrite" = fn(c_int, c_long, *mut c_void, c_uint, c_uint) -> c_int;
        read_wait: "canReadWait" =
            fn(c_int, *mut c_long, *mut c_void, *mut c_uint, *mut c_uint, *mut c_ulong, c_ulong) -> c_int;
        status: "canReadStatus" = fn(c_int, *mut c_ulong) -> c_int;
        counters: "canReadErrorCounters" = fn(c_int, *mut c_uint, *mut c_uint, *mut c_uint) -> c_int;
    }
    safe {
        open: "canOpenChannel" = fn(channel: c_int, flags: c_int) -> c_int;
        close: "canClose" = fn(handle: c_int) -> c_int;
        bus_on: "canBusOn" = fn(handle: c_int) -> c_int;
        bus_off: "canBusOff" = fn(handle: c_int) -> c_int;
    }
}

impl Canlib {
    /// Loads the library, and calls its `canInitializeLibrary`.
    ///
    /// # Errors
    /// The library is missing or too old.
    pub fn load() -> Result<Self, LoadError> {
        let loaded = Self::find()?;
        // SAFETY: the function has no arguments.
        unsafe { (loaded.initialize)() };
        Ok(loaded)
    }

    /// `canGetNumberOfChannels`: returns a `canStatus` and the number.
    pub fn channels(&self) -> (i32, i32) {
        let mut count = 0;
        // SAFETY: the number is a local variable.
        let status = unsafe { (self.channels)(&raw mut count) };
        (status, count)
    }

    /// `canGetChannelData` of a text item: returns its bytes up to the first zero.
    pub fn text(&self, channel: i32, item: i32) -> (i32, Vec<u8>) {
        let mut text = [0_u8; 256];
        // SAFETY: the buffer is a local variable and longer than the passed length.
        let status = unsafe { (self.channel_data)(channel, item, text.as_mut_ptr().cast(), 255) };
        (status, text.into_iter().take_while(|byte| *byte != 0).collect())
    }

    /// `canSetBusParams` with one sample for each bit: a bit rate in bit/s with its segments in
    /// time quanta, or one of the `canBITRATE_…` with zeros.
    pub fn bus_parameters(&self, handle: i32, rate: i32, segments: (u32, u32), jump_width: u32) -> i32 {
        let (before, behind) = segments;
        let samples = u32::from(before != 0);
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.bus_parameters)(handle, rate.into(), before, behind, jump_width, samples, 0) }
    }

    /// `canWrite`; `data` has at most 8 bytes. Does not wait.
    pub fn write(&self, handle: i32, id: u32, data: &[u8], len: u32, flags: u32) -> i32 {
        let mut bytes = [0_u8; 8];
        for (byte, value) in bytes.iter_mut().zip(data) {
            *byte = *value;
        }
        // Identifiers have 29 bits.
        let id = c_long::try_from(id).unwrap_or_default();
        // SAFETY: the library reads at most 8 bytes, and the buffer has 8 bytes.
        unsafe { (self.write)(handle, id, bytes.as_mut_ptr().cast(), len.min(8), flags) }
    }

    /// `canReadWait` with a time in milliseconds.
    pub fn read_wait(&self, handle: i32, wait: u32) -> (i32, Message) {
        let (mut id, mut len, mut flags, mut time): (c_long, c_uint, c_uint, c_ulong) = (0, 0, 0, 0);
        // A library that takes the channel for a CAN FD channel writes up to 64 bytes.
        let mut data = [0_u8; 64];
        // SAFETY: all arguments are local variables with the types of the header.
        let status = unsafe {
            (self.read_wait)(
                handle,
                &raw mut id,
                data.as_mut_ptr().cast(),
                &raw mut len,
                &raw mut flags,
                &raw mut time,
                wait.into(),
            )
        };
        let data = std::array::from_fn(|at| data[at]);
        (status, Message { id: id.into(), len, flags, data })
    }

    /// `canReadStatus`: returns the bits of `canSTAT_…`.
    pub fn status(&self, handle: i32) -> (i32, u64) {
        let mut flags: c_ulong = 0;
        // SAFETY: the number is a local variable.
        let status = unsafe { (self.status)(handle, &raw mut flags) };
        (status, flags.into())
    }

    /// `canReadErrorCounters`: returns the transmit and the receive error counter.
    pub fn counters(&self, handle: i32) -> (i32, u32, u32) {
        let (mut send, mut receive, mut overruns) = (0, 0, 0);
        // SAFETY: the numbers are local variables.
        let status = unsafe { (self.counters)(handle, &raw mut send, &raw mut receive, &raw mut overruns) };
        (status, send, receive)
    }
}
