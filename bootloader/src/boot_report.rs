//! What the boot stage tells the RAM part of the bootloader.

use shared_abi::warm_start::Owed;

/// Why the bootloader runs, and what is left for it to do.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct BootReport {
    /// [`StayReason::code`](boot_core::decision::StayReason::code).
    pub reason: u8,
    /// The program that starts when the rescue window is over; 0 for none.
    pub held_program: u8,
    /// How long the rescue window is, in ms.
    pub window_ms: u16,
    /// The write of 1F51h that the application has left to be answered here; its node-ID is 0 for none.
    pub owed: Owed,
    /// The program that has brought the device back to the bootloader; 0 for none.
    pub returned: u8,
    /// Node-ID in force from this reset on; 255 for none.
    pub node_id: u8,
    /// Bit rate in force from this reset on, as the index of CiA 305 table 1.
    pub bit_rate: u8,
}
