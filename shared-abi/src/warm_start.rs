//! The warm-start cell: requests of the application to the bootloader across a reset.
//!
//! The cell is the last RAM cell of the chip
//! ([`Layout::warm_start`](crate::layout::Layout::warm_start)), outside the RAM of the images. It
//! survives a warm reset and holds noise after a power-on. Its contents are not trusted, and they
//! are read once: [`Cell::take`] consumes them.

use crate::check_word;

/// Identifies a warm-start cell, layout version 1 ("CBW1" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBW1");

/// Why the RAM image cannot run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Damage {
    /// The header is missing, or contains a size or an address that cannot be.
    Header = 1,
    /// The image needs services or abilities that this resident part has not.
    Services = 2,
    /// The CRC is wrong.
    Crc = 3,
    /// The image is for another board.
    Board = 4,
    /// Its stack pointer or its reset vector points out of its RAM.
    Vectors = 5,
    /// The image was built for a resident part with other [facts](crate::services::Facts).
    Facts = 6,
}

impl Damage {
    /// The damage with this number.
    #[must_use]
    pub const fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            1 => Self::Header,
            2 => Self::Services,
            3 => Self::Crc,
            4 => Self::Board,
            5 => Self::Vectors,
            6 => Self::Facts,
            _ => return None,
        })
    }
}

/// A request for the next start of the bootloader.
///
/// The discriminants are the numbers in the cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum BootRequest {
    /// Stay in the bootloader, even if a valid program exists (1F51h = 80h, START_BOOTLOADER).
    Stay = 1,
    /// Start program `n` once, even if it is not released for autostart; after the next reset the
    /// device stays in the bootloader.
    Trial(u8) = 2,
    /// Start program `n` like the autostart.
    Start(u8) = 3,
    /// Stay, because the bootloader itself had a fault or a panic; the bootloader writes this
    /// request itself.
    Fault = 4,
    /// Start as after a power-on: the request of an NMT reset. It does not count as a crash.
    PowerOn = 5,
    /// Continue with the start of program `n`, which was delayed for a rescue window; the
    /// bootloader writes this request itself.
    Resume(u8) = 6,
    /// Stay and answer: a command was written to 1F51h of the application, which left the SDO
    /// answer to the bootloader. After its boot-up message the bootloader carries out the command
    /// as if it had just arrived.
    Owed(Owed) = 7,
    /// The bootloader mode cannot run, because its part of the flash is damaged. The boot stage
    /// leaves this request for a debugger, and starts as after a power-on.
    Damaged(Damage) = 8,
    /// Start program `n`, which was just downloaded as a raw image, Intel HEX or a sealed image:
    /// like a [`Trial`](Self::Trial), but the handoff marks the program as fresh. The bootloader
    /// writes this request itself.
    Fresh(u8) = 9,
    /// Confirm program `n`, then start it. The callgate uses this and the next two requests when it
    /// cannot store, because the flash is locked for a sealed program
    /// ([`Status::Locked`](crate::callgate::Status::Locked)). A bootloader without sealed images
    /// stores nothing.
    Confirm(u8) = 10,
    /// Withdraw the release of program `n`, then start as after a power-on.
    Invalidate(u8) = 11,
    /// Store node parameters, then start as after a power-on.
    StoreNode(StoredNode) = 12,
    /// A step in the trial of a new RAM image ([`crate::renewal`]). The bootloader writes this request
    /// itself.
    Renewal(TrialStep) = 13,
    /// Leave for the loader in the ROM of the chip ([`VectorTable::of_rom`](crate::vectors::VectorTable::of_rom)). The
    /// bootloader writes this request itself, in a product that permits it; another one starts as after a
    /// power-on.
    RomLoader = 14,
    /// Start as after a power-on, with the rescue window of a program that was never confirmed: the
    /// program has refused to leave for the bootloader, and NMT reset node came.
    Rescue = 16,
}

/// A step in the trial of a new RAM image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum TrialStep {
    /// Load the image from staging once.
    Try = 1,
    /// It was not confirmed in time: load the one at home, and stay.
    Late = 2,
    /// A master has given it up: load the one at home, and stay.
    GivenUp = 3,
}

impl TrialStep {
    /// The step with this number.
    #[must_use]
    pub const fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            1 => Self::Try,
            2 => Self::Late,
            3 => Self::GivenUp,
            _ => return None,
        })
    }
}

/// Node parameters in the cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct StoredNode {
    /// 1 to 127; 255 for none.
    pub node_id: u8,
    /// In units of 5 kbit/s, a divisor of all bit rates of CANopen; 0 for a bit rate that is
    /// detected by listening.
    pub bit_rate: u8,
}

impl StoredNode {
    /// From a node-ID and a bit rate in bit/s, up to 1 275 000; the bit rate is rounded down to a
    /// multiple of 5 kbit/s.
    #[must_use]
    pub const fn new(node_id: u8, bit_rate: u32) -> Self {
        Self { node_id, bit_rate: (bit_rate / 5000) as u8 }
    }

    /// The bit rate in bit/s.
    #[must_use]
    pub const fn bits_per_second(self) -> u32 {
        self.bit_rate as u32 * 5000
    }
}

/// A write to 1F51h with an SDO answer that the bootloader must send.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct Owed {
    /// The sub-index, 1 to 254.
    pub program: u8,
    /// The written value: 0 STOP or 3 CLEAR.
    pub value: u8,
    /// The addressed node, 1 to 127. A bootloader with another node-ID does not send the answer. 0: the
    /// program has answered STOP itself, which the bootloader then counts as its own.
    pub node_id: u8,
}

impl Owed {
    /// No answer is owed.
    pub const NOTHING: Self = Self { program: 0, value: 0, node_id: 0 };
}

/// The cell in RAM: 16 bytes, little-endian.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WarmStart {
    /// [`MAGIC`].
    pub magic: u32,
    /// 1 stay, 2 trial, 3 start, 4 fault, 5 as after a power-on, 6 resume, 7 owed, 8 damaged, 9
    /// fresh, 10 confirm, 11 invalidate, 12 store node parameters, 13 renewal, 14 loader in the
    /// ROM, 16 as after a power-on with a rescue window; 0 none, which may have the mark. 15 is kept
    /// for the installation of a stored program ([the rules](crate#records-that-stay-for-ever)).
    pub request: u32,
    /// The program number (1 to 254) for a trial, start, resume, fresh start, confirm or invalidate
    /// request; the number of a [`Damage`]; for an owed answer, the program number in bits 0 to 7,
    /// the value in bits 8 to 15 and the node-ID in bits 16 to 22; for node parameters, the node-ID
    /// in bits 0 to 7 and the bit rate in bits 8 to 15; the number of a [`TrialStep`]; 1 for the mark;
    /// otherwise 0.
    pub argument: u32,
    /// [`check_word`] of the three words before.
    pub check: u32,
}

impl WarmStart {
    /// A cell without a request.
    pub const EMPTY: Self = Self { magic: 0, request: 0, argument: 0, check: 0 };
    /// A cell with the mark, which is no request: the NRST pin has reset the device, and the time in which a
    /// second such reset keeps it in the bootloader is not over.
    pub const MARKED: Self = Self::encode(0, 1);

    /// The cell with this request.
    #[must_use]
    pub const fn new(request: BootRequest) -> Self {
        let (request, argument) = match request {
            BootRequest::Stay => (1, 0),
            BootRequest::Trial(program) => (2, program as u32),
            BootRequest::Start(program) => (3, program as u32),
            BootRequest::Fault => (4, 0),
            BootRequest::PowerOn => (5, 0),
            BootRequest::Resume(program) => (6, program as u32),
            BootRequest::Owed(Owed { program, value, node_id }) => {
                (7, u32::from_le_bytes([program, value, node_id, 0]))
            }
            BootRequest::Damaged(damage) => (8, damage as u32),
            BootRequest::Fresh(program) => (9, program as u32),
            BootRequest::Confirm(program) => (10, program as u32),
            BootRequest::Invalidate(program) => (11, program as u32),
            BootRequest::StoreNode(StoredNode { node_id, bit_rate }) => {
                (12, u32::from_le_bytes([node_id, bit_rate, 0, 0]))
            }
            BootRequest::Renewal(step) => (13, step as u32),
            BootRequest::RomLoader => (14, 0),
            BootRequest::Rescue => (16, 0),
        };
        Self::encode(request, argument)
    }

    /// The cell with these words, valid or not.
    #[must_use]
    pub const fn encode(request: u32, argument: u32) -> Self {
        let check = check_word(&[MAGIC, request, argument]);
        Self { magic: MAGIC, request, argument, check }
    }

    /// The request in the cell, or `None` for noise, another version, a wrong check word, an
    /// unknown request or an argument out of range.
    #[must_use]
    pub fn request(&self) -> Option<BootRequest> {
        if *self != Self::encode(self.request, self.argument) {
            return None;
        }
        let [program, value, node_id, _] = self.argument.to_le_bytes();
        Some(match (self.request, self.argument) {
            (1, 0) => BootRequest::Stay,
            (2, 1..=254) => BootRequest::Trial(program),
            (3, 1..=254) => BootRequest::Start(program),
            (4, 0) => BootRequest::Fault,
            (5, 0) => BootRequest::PowerOn,
            (6, 1..=254) => BootRequest::Resume(program),
            (7, ..=0x00FF_FFFF) if (1..=254).contains(&program) => {
                BootRequest::Owed(Owed { program, value, node_id })
            }
            (8, ..=0xFF) => BootRequest::Damaged(Damage::from_number(program)?),
            (9, 1..=254) => BootRequest::Fresh(program),
            (10, 1..=254) => BootRequest::Confirm(program),
            (11, 1..=254) => BootRequest::Invalidate(program),
            (12, ..=0xFFFF) => BootRequest::StoreNode(StoredNode { node_id: program, bit_rate: value }),
            (13, ..=0xFF) => BootRequest::Renewal(TrialStep::from_number(program)?),
            (14, 0) => BootRequest::RomLoader,
            (16, 0) => BootRequest::Rescue,
            _ => return None,
        })
    }
}

/// The cell at its place in RAM.
#[derive(Debug)]
pub struct Cell(*mut WarmStart);

impl Cell {
    /// The cell at `address`.
    ///
    /// # Safety
    /// `address` must be word-aligned RAM of 16 bytes that nothing else in the program uses: the
    /// layout's warm-start region, which the linker scripts keep out of every image.
    #[must_use]
    pub const unsafe fn at(address: *mut WarmStart) -> Self {
        Self(address)
    }

    /// Reads the request and empties the cell, so that no later reset reads it again.
    pub fn take(&mut self) -> Option<BootRequest> {
        // SAFETY: the caller of `at` guarantees the address; volatile, because another image wrote
        // the cell.
        let found = unsafe { self.0.read_volatile() };
        self.clear();
        found.request()
    }

    /// Whether the cell has the [mark](WarmStart::MARKED). [`take`](Self::take) removes it.
    #[must_use]
    pub fn is_marked(&self) -> bool {
        // SAFETY: as in `take`.
        unsafe { self.0.read_volatile() == WarmStart::MARKED }
    }

    /// Sets the [mark](WarmStart::MARKED), in place of a request.
    pub fn mark(&mut self) {
        self.write(WarmStart::MARKED);
    }

    /// Empties the cell: there is neither a request nor the mark.
    pub fn clear(&mut self) {
        self.write(WarmStart::EMPTY);
    }

    /// Writes a request for the bootloader, in place of the mark. The write is complete when this returns, so a reset may
    /// follow at once.
    pub fn put(&mut self, request: BootRequest) {
        self.write(WarmStart::new(request));
    }

    fn write(&mut self, value: WarmStart) {
        // SAFETY: the caller of `at` guarantees the address; volatile, because only another image
        // reads the cell.
        unsafe { self.0.write_volatile(value) };
        #[cfg(target_arch = "arm")]
        // SAFETY: `dsb` has no operands; it waits until the store above has reached the RAM.
        unsafe {
            core::arch::asm!("dsb", options(nostack, preserves_flags));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 255 is the largest number of 5 kbit/s in a byte.
    #[test]
    fn a_bit_rate_is_kept_in_units_of_5_kbit_per_second() {
        for (given, kept) in
            [(0, 0), (10_000, 10_000), (1_000_000, 1_000_000), (1_275_000, 1_275_000), (9_999, 5_000)]
        {
            assert_eq!(StoredNode::new(1, given).bits_per_second(), kept);
        }
    }

    /// A reader without the mark sees a request that it does not know. Every request replaces the mark, a *try*
    /// and a confirmation among them, and it is gone when the cell was read.
    #[test]
    fn the_mark_is_no_request_and_ends_with_the_next_use_of_the_cell() {
        let marked = WarmStart { magic: MAGIC, request: 0, argument: 1, check: check_word(&[MAGIC, 0, 1]) };
        let mut ram = WarmStart::EMPTY;
        let at = &raw mut ram;
        // SAFETY: `ram` belongs to this test and outlives the cell.
        let mut cell = unsafe { Cell::at(at) };
        assert!(!cell.is_marked());
        cell.mark();
        // SAFETY: as above.
        assert_eq!(unsafe { at.read_volatile() }, marked, "the value is frozen");
        assert!(cell.is_marked(), "to look at it changes nothing");
        assert!(cell.is_marked());
        assert_eq!((cell.take(), cell.is_marked()), (None, false));
        cell.mark();
        cell.clear();
        assert!(!cell.is_marked());
        for request in [BootRequest::Renewal(TrialStep::Try), BootRequest::Confirm(1), BootRequest::Start(1)]
        {
            cell.mark();
            cell.put(request);
            assert!(!cell.is_marked());
            assert_eq!([cell.take(), cell.take()], [Some(request), None], "it is consumed on read");
        }
    }

    #[test]
    fn a_well_checked_request_for_an_impossible_program_is_refused() {
        #[rustfmt::skip]
        let impossible = [
            (1, 1), (2, 0), (2, 255), (3, 0), (3, 256), (0, 0), (0, 1), (4, 1), (5, 1), (6, 0), (7, 0x0001_0000),
            (7, 0x0001_00FF), (7, 0x0101_0001), (8, 0), (8, 7), (9, 0), (9, 0x0101), (10, 0), (10, 255), (11, 0x0101),
            (12, 0x0001_0001), (13, 0), (13, 4), (13, 0x0101), (14, 1), (15, 0), (15, 1), (16, 1),
        ];
        for (request, argument) in impossible {
            let check = check_word(&[MAGIC, request, argument]);
            let cell = WarmStart { magic: MAGIC, request, argument, check };
            assert_eq!(cell.request(), None, "{cell:?}");
        }
    }
}
