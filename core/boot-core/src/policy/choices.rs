//! The product's choices about downloads.

use canopen::program::FlashError;
use shared_abi::abilities::Abilities;
use shared_abi::block_file::Control;
use shared_abi::ram_image::Host;

use crate::crc::CrcKind;
use crate::queue::Queue;
use crate::session::Session;

/// The time of the erase for CLEAR.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Erase {
    /// With the first block that is for this device: until then the old program stays and can be
    /// started. Sectors are erased as the data need them. A second CLEAR without a block in between
    /// erases everything at once.
    #[default]
    WithFirstBlock,
    /// At once: all sectors of the program are erased before anything else.
    AtOnce,
}

/// The result of the integrator's own check of a program before its download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// No decision: vendor-ID and product code decide.
    Standard,
    /// The program is for this device.
    Accept,
    /// The program is not for this device.
    Refuse(FlashError),
}

/// What the integrator's own check gets: the data of block 0, or those of the label in the image.
#[derive(Clone, Copy)]
pub struct AppInfo<'a> {
    /// Identity, version and date. `None` if block 0 has a length that the manual does not define: its
    /// data have a meaning for the integrator alone.
    pub control: Option<Control>,
    /// Where the data of block 0 are the open piece; `None` for a label.
    block: Option<&'a Queue<'a>>,
}

impl<'a> AppInfo<'a> {
    /// Block 0, whose data are the open piece of the queue.
    pub(crate) const fn of_block(control: Option<Control>, block: &'a Queue<'a>) -> Self {
        Self { control, block: Some(block) }
    }

    /// The label of an image.
    pub(crate) const fn of_label(control: Control) -> Self {
        Self { control: Some(control), block: None }
    }

    /// The data of block 0 as they were sent, 0 to 16 368 bytes; none for a label.
    pub fn bytes(&self) -> impl ExactSizeIterator<Item = u8> + use<'a> {
        let block = self.block;
        let size = block.map_or(0, Queue::open_size);
        (0..size).map(move |at| block.map_or(0, |block| block.open_byte(at)))
    }
}

/// The product's choices about downloads.
#[derive(Clone, Copy, Debug)]
pub struct Policy {
    /// Vendor-ID and product code of the device. A control block with other values is refused; 0 in
    /// a control block is any value, and 0 and 0 here take any program
    /// ([`fits`](shared_abi::block_file::fits)).
    pub identity: Option<(u32, u32)>,
    /// The integrator's own check (`TgtProcessAppInfoData` of the manual). A block 0 of a length that the
    /// manual does not define is refused unless this accepts it.
    pub check: fn(program: u8, info: &AppInfo<'_>) -> Verdict,
    /// Whether programs may be changed now; if not, the status is `NO_ACCESS`.
    pub allowed: fn() -> bool,
    /// When CLEAR of a program erases (`TgtCheckEraseApp` of the manual).
    pub erase: fn(program: u8) -> Erase,
    /// Whether a complete download of a raw image or Intel HEX is valid without the release (83h),
    /// which hosts with these formats do not send.
    pub valid_without_signature: bool,
    /// Whether 1F51h = 2 always starts the program, as in CiA 302-3. Otherwise it starts the
    /// program only directly after a raw image or Intel HEX, and resets the status in all other
    /// cases.
    pub reset_starts: bool,
    /// Whether a valid raw image or Intel HEX starts by itself after its download.
    pub starts_by_itself: bool,
    /// Whether a program must contain a label (`shared_abi::label`). If a program contains a label,
    /// the label must match in any case.
    pub wants_label: bool,
    /// The number of a program that is data of the application: any bytes, never started.
    pub data: Option<u8>,
    /// Whether 1F50h accepts data only after a password.
    pub locked: bool,
    /// Whether a client can read the stored program from 1F50h.
    pub read_back: bool,
    /// Whether a download replaces the existing program without CLEAR.
    pub replaces: bool,
    /// The CRC of blocks and programs.
    pub crc: CrcKind,
    /// The bytes of flash that one step of a CRC covers. One step is the longest time that other
    /// work of the same priority must wait.
    pub crc_step: u32,
    /// The values with which a sealed image is checked.
    pub seal: SealPolicy,
    /// The values for a renewal of the bootloader; `None` for a device without it.
    pub renewal: Option<&'static Renewal>,
}

/// The values for a renewal of the bootloader (docs/renewal.md).
#[derive(Clone, Copy, Debug)]
pub struct Renewal {
    /// The identity of the board, as in the header of a RAM image.
    pub board: u32,
    /// The abilities of the resident part.
    pub features: Abilities,
    /// Vendor-ID and product code of the device, which an image must have; `None` for any.
    pub identity: Option<(u32, u32)>,
    /// The revision number of the device (1018h/3); the five lowest bits are the hardware revision.
    pub revision: u32,
    /// The time within which an image on trial must be confirmed, in seconds.
    pub confirm_within_s: u16,
}

impl Renewal {
    /// What the device has for a RAM image, with this version of the services and these facts.
    pub(crate) const fn host(&self, services: u32, facts: u32) -> Host {
        Host { board: self.board, services, features: self.features, facts }
    }

    /// Values of no device.
    pub const NONE: Self =
        Self { board: 0, features: Abilities::NONE, identity: None, revision: 0, confirm_within_s: 60 };
}

/// The values with which a sealed image is checked, besides the keys in the device.
#[derive(Clone, Copy, Debug)]
pub struct SealPolicy {
    /// Vendor-ID of the device (1018h/1).
    pub vendor_id: u32,
    /// Its product code (1018h/2).
    pub product_code: u32,
    /// Its revision number (1018h/3); the five lowest bits are the hardware revision.
    pub revision: u32,
    /// The program number that is for data of the application.
    pub data: Option<u8>,
    /// The 96-bit unique ID of the chip.
    pub unique_id: fn() -> [u8; 12],
    /// Returns a number that cannot be predicted to the last bit, such as the count of clock cycles
    /// at the time of the call.
    pub cycles: fn() -> u32,
    /// The lowest security counter, whatever value is stored.
    pub counter: u32,
    /// Whether the counter is raised at the confirmation of a program instead of its installation:
    /// until then the device accepts older programs.
    pub counter_with_confirmation: bool,
}

impl SealPolicy {
    /// Values that match no device.
    pub const NONE: Self = Self {
        vendor_id: 0,
        product_code: 0,
        revision: 0,
        data: None,
        unique_id: || [0; 12],
        cycles: || 0,
        counter: 0,
        counter_with_confirmation: false,
    };
}

impl Policy {
    /// Programs for any device at any time; steps of 1 KiB.
    pub const DEFAULT: Self = Self {
        identity: None,
        check: |_, _| Verdict::Standard,
        allowed: || true,
        erase: |_| Erase::WithFirstBlock,
        valid_without_signature: true,
        reset_starts: false,
        starts_by_itself: false,
        wants_label: false,
        data: None,
        locked: false,
        read_back: false,
        replaces: false,
        crc: CrcKind::Crc32,
        crc_step: 1024,
        seal: SealPolicy::NONE,
        renewal: None,
    };

    /// Whether a download that begins in this state first erases the flash. Otherwise each piece
    /// must find its place erased.
    pub(crate) fn erases(&self, session: Session) -> bool {
        matches!(session, Session::Cleared { .. })
            || self.replaces && !matches!(session, Session::Open { .. })
    }
}
