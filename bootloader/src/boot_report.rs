//! The boot stage's report to the RAM part of the bootloader.

use shared_abi::warm_start::Owed;

/// The reason why the bootloader runs, and the work that is left for it.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct BootReport {
    /// [`StayReason::code`](boot_core::decision::StayReason::code).
    pub reason: u8,
    /// The program that starts when the rescue window is over; 0 for none.
    pub held_program: u8,
    /// Length of the rescue window, in ms.
    pub window_ms: u16,
    /// The write of 1F51h that the application received and the bootloader answers; its node-ID is
    /// 0 if there is none.
    pub owed: Owed,
    /// The program that returned control to the bootloader; 0 for none.
    pub returned: u8,
    /// Node-ID in force from this reset on; 255 for none.
    pub node_id: u8,
    /// Bit rate in force from this reset on, as the index of CiA 305 table 1.
    pub bit_rate: u8,
}
