//! What the boot stage tells the RAM part of the bootloader.

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
    /// The program whose CLEAR was asked of the application; 0 for none.
    pub clear: u8,
    /// The program that has brought the device back to the bootloader; 0 for none.
    pub returned: u8,
}
