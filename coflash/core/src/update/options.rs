//! The options of an update.

use std::time::Duration;

use super::password::Password;
use crate::device::Dialect;
use crate::file::Target;

/// The options of an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct FlashOptions {
    /// The program: sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
    pub program: u8,
    /// How many times one block is sent again after a CRC error or a broken transfer.
    pub repeats: u32,
    /// Compare the device's identity with this target before anything is erased, and the identity
    /// of the program on trial again.
    pub check_target: Option<Target>,
    /// Start the program once and call it back before it is released for autostart (steps 10 to
    /// 13), if the dialect has such a release and `start` is set.
    pub trial_run: bool,
    /// How long a program is watched after each start, from its first frame on; `None` for a second, or
    /// twice the time of the watchdog that the device starts for it.
    pub watch: Option<Duration>,
    /// Start the program at the end (step 15). If this is off, the program is neither tried nor
    /// released for autostart.
    pub start: bool,
    /// At the very end, compare the CRC that the running program reports.
    pub verify: bool,
    /// The dialect of the device; `None` to detect it.
    pub dialect: Option<Dialect>,
    /// The password of the device, in dialects that need one.
    pub unlock: Option<Password>,
    /// Whether the session can follow a device to another node-ID, which lift devices need. One of
    /// several parallel sessions cannot.
    pub follow: bool,
    /// Search until the bootloader answers or the user cancels (manual, chapter 5.2, step 1):
    /// neither silence nor an application that stays ends the procedure.
    pub wait: bool,
    /// Stop before anything is changed if another tool talks to the device.
    pub alone: bool,
    /// Take the NMT mastership during the update of a lift device, and give it back (CiA 814-1
    /// clause 6.3).
    pub mastership: bool,
    /// Join blocks of the file up to this size, including framing, where the device takes them: fewer
    /// blocks need fewer answers. `None` sends the file's own blocks.
    pub joined_blocks: Option<usize>,
    /// Send a sealed image in blocks of at most this size, including framing, instead of in one
    /// download.
    pub blocks: Option<usize>,
    /// Fail before anything is erased if the device cannot be updated together with others.
    pub together: bool,
    /// Send everything, also if the device could go on with a download that was cut off.
    pub from_start: bool,
    /// Let the device alone judge the image. If this is off, the tool refuses an image that cannot
    /// be a program, or that is for another device or another region, before it changes the device.
    pub force: bool,
}

/// The size of joined blocks, framing included. A bootloader of coboot that has less room refuses
/// the first of them by its header, and then gets the file's own blocks.
pub const JOINED_BLOCKS: usize = 0x1000;

impl FlashOptions {
    setters! {
        program: u8,
        repeats: u32,
        check_target: Option<Target>,
        trial_run: bool,
        watch: Option<Duration>,
        start: bool,
        verify: bool,
        dialect: Option<Dialect>,
        unlock: Option<Password>,
        follow: bool,
        wait: bool,
        alone: bool,
        mastership: bool,
        blocks: Option<usize>,
        joined_blocks: Option<usize>,
        together: bool,
        from_start: bool,
        force: bool,
    }
}

impl Default for FlashOptions {
    fn default() -> Self {
        Self {
            program: 1,
            repeats: 3,
            check_target: None,
            trial_run: true,
            watch: None,
            start: true,
            verify: false,
            dialect: None,
            unlock: None,
            follow: true,
            wait: false,
            alone: true,
            mastership: true,
            blocks: None,
            joined_blocks: Some(JOINED_BLOCKS),
            together: false,
            from_start: false,
            force: false,
        }
    }
}
