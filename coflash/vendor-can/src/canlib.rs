//! CANlib of Kvaser: the functions that a classic CAN adapter needs.
//!
//! Signatures are those of the public header `canlib.h` (CANlib 5); `long` has the system's width.

// A conversion that is necessary on one system is useless on another, where `long` has 64 bits.
#![allow(clippy::useless_conversion, clippy::unnecessary_fallible_conversions)]

use std::ffi::{c_int, c_long, c_uint, c_ulong, c_void};
use std::fmt;

use crate::load::Loaded;
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

type Nothing = unsafe extern "system" fn();
type Channels = unsafe extern "system" fn(*mut c_int) -> c_int;
type ChannelData = unsafe extern "system" fn(c_int, c_int, *mut c_void, usize) -> c_int;
type Open = unsafe extern "system" fn(c_int, c_int) -> c_int;
type OfHandle = unsafe extern "system" fn(c_int) -> c_int;
type BusParameters =
    unsafe extern "system" fn(c_int, c_long, c_uint, c_uint, c_uint, c_uint, c_uint) -> c_int;
type Write = unsafe extern "system" fn(c_int, c_long, *mut c_void, c_uint, c_uint) -> c_int;
type ReadWait = unsafe extern "system" fn(
    c_int,
    *mut c_long,
    *mut c_void,
    *mut c_uint,
    *mut c_uint,
    *mut c_ulong,
    c_ulong,
) -> c_int;
type Status = unsafe extern "system" fn(c_int, *mut c_ulong) -> c_int;
type Counters = unsafe extern "system" fn(c_int, *mut c_uint, *mut c_uint, *mut c_uint) -> c_int;

/// The library.
pub struct Canlib {
    channels: Channels,
    channel_data: ChannelData,
    open: Open,
    close: OfHandle,
    bus_parameters: BusParameters,
    bus_on: OfHandle,
    bus_off: OfHandle,
    write: Write,
    read_wait: ReadWait,
    status: Status,
    counters: Counters,
    // The last field, because the functions above belong to it.
    _library: Loaded,
}

impl fmt::Debug for Canlib {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Canlib(…)")
    }
}

impl Canlib {
    /// Loads the library, and calls its `canInitializeLibrary`.
    ///
    /// # Errors
    /// The library is missing or too old.
    pub fn load() -> Result<Self, LoadError> {
        // SAFETY: the files come from the vendor's installer; the types are those of canlib.h, and
        // the functions live as long as the library beside them.
        unsafe {
            let library = Loaded::first_of(FILES)?;
            let initialize: Nothing = library.function("canInitializeLibrary")?;
            let loaded = Self {
                channels: library.function("canGetNumberOfChannels")?,
                channel_data: library.function("canGetChannelData")?,
                open: library.function("canOpenChannel")?,
                close: library.function("canClose")?,
                bus_parameters: library.function("canSetBusParams")?,
                bus_on: library.function("canBusOn")?,
                bus_off: library.function("canBusOff")?,
                write: library.function("canWrite")?,
                read_wait: library.function("canReadWait")?,
                status: library.function("canReadStatus")?,
                counters: library.function("canReadErrorCounters")?,
                _library: library,
            };
            initialize();
            Ok(loaded)
        }
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

    /// `canOpenChannel`: returns a handle or a negative `canStatus`.
    pub fn open(&self, channel: i32, flags: i32) -> i32 {
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.open)(channel, flags) }
    }

    /// `canClose`.
    pub fn close(&self, handle: i32) -> i32 {
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.close)(handle) }
    }

    /// `canSetBusParams` with one sample for each bit: a bit rate in bit/s with its segments in
    /// time quanta, or one of the `canBITRATE_…` with zeros.
    pub fn bus_parameters(&self, handle: i32, rate: i32, segments: (u32, u32), jump_width: u32) -> i32 {
        let (before, behind) = segments;
        let samples = u32::from(before != 0);
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.bus_parameters)(handle, rate.into(), before, behind, jump_width, samples, 0) }
    }

    /// `canBusOn`.
    pub fn bus_on(&self, handle: i32) -> i32 {
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.bus_on)(handle) }
    }

    /// `canBusOff`.
    pub fn bus_off(&self, handle: i32) -> i32 {
        // SAFETY: the arguments are plain numbers.
        unsafe { (self.bus_off)(handle) }
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
