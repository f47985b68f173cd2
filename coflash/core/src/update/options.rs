//! The options of an update.

use std::time::Duration;

use super::password::Password;
use crate::device::Dialect;
use crate::file::Target;

options! {
    /// The options of an update.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct FlashOptions {
        /// The program: sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
        pub program: u8 = 1,
        /// How many times one block is sent again after a CRC error or a broken transfer.
        pub repeats: u32 = 3,
        /// Compare the device's identity with this target before anything is erased, and the
        /// identity of the program on trial again.
        pub check_target: Option<Target> = None,
        /// Start the program once and call it back before it is released for autostart (steps 10 to
        /// 13), if the dialect has such a release and `start` is set.
        pub trial_run: bool = true,
        /// How long a program is watched after each start, from its first frame on; `None` for a
        /// second, or twice the time of the watchdog that the device starts for it.
        pub watch: Option<Duration> = None,
        /// Start the program at the end (step 15). If this is off, the program is neither tried nor
        /// released for autostart.
        pub start: bool = true,
        /// At the very end, compare the CRC that the running program reports.
        pub verify: bool = false,
        /// The dialect of the device; `None` to detect it.
        pub dialect: Option<Dialect> = None,
        /// The password of the device, in dialects that need one.
        pub unlock: Option<Password> = None,
        /// Whether the session can follow a device to another node-ID, which lift devices need. One
        /// of several parallel sessions cannot.
        pub follow: bool = true,
        /// Search until the bootloader answers or the user cancels (manual, chapter 5.2, step 1):
        /// neither silence nor an application that stays ends the procedure.
        pub wait: bool = false,
        /// Stop before anything is changed if another tool talks to the device.
        pub alone: bool = true,
        /// Take the NMT mastership during the update of a lift device, and give it back (CiA 814-1
        /// clause 6.3).
        pub mastership: bool = true,
        /// Join blocks of the file up to this size, including framing, where the device takes them:
        /// fewer blocks need fewer answers. `None` sends the file's own blocks.
        pub joined_blocks: Option<usize> = Some(JOINED_BLOCKS),
        /// Send a sealed image in blocks of at most this size, including framing, instead of in one
        /// download.
        pub blocks: Option<usize> = None,
        /// Fail before anything is erased if the device cannot be updated together with others.
        pub together: bool = false,
        /// Send everything, also if the device could go on with a download that was cut off.
        pub from_start: bool = false,
        /// Let the device alone judge the image. If this is off, the tool refuses an image that
        /// cannot be a program, or that is for another device or another region, before it changes
        /// the device.
        pub force: bool = false,
    }
}

/// The size of joined blocks, framing included. A bootloader of coboot that has less room refuses
/// the first of them by its header, and then gets the file's own blocks.
pub const JOINED_BLOCKS: usize = 0x1000;
