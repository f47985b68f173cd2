//! How the program was started.

use shared_abi::date::days_and_milliseconds;
use shared_abi::geometry::OTP;
use shared_abi::handoff::{BootInfo, Handoff, SdoBases};
use shared_abi::layout::Layout;
use shared_abi::nameplate::{Nameplate, Words};

/// The values to use when no bootloader has started the program (but a debugger, for example).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Defaults {
    /// Node-ID, 1 to 127; `None` for a device that waits for layer setting services.
    pub node_id: Option<u8>,
    /// Bit rate in bit/s; 0 for a device that finds it out by listening.
    pub bit_rate: u32,
    /// 1018h/4.
    pub serial_number: u32,
}

/// How the program was started: the bootloader's values, or the defaults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Start {
    /// Node-ID to use, 1 to 127; `None` if there is none.
    pub node_id: Option<u8>,
    /// Bit rate to use, in bit/s; 0 for a device that finds it out by listening.
    pub bit_rate: u32,
    /// 1018h/4.
    pub serial_number: u32,
    /// The program that this is, 1 to 254: the sub-index of 1F51h that is its own.
    pub program: u8,
    /// It was started right after its download in one go (raw image, Intel HEX or sealed image): the
    /// first 1F51h = 80h confirms it.
    pub fresh: bool,
    /// All values of the bootloader; `None` if no bootloader started the program.
    pub reported: Option<BootInfo>,
}

impl Start {
    /// Reads the handoff of the bootloader. Once, before CAN is set up.
    #[must_use]
    pub fn read(layout: &Layout, defaults: Defaults) -> Self {
        // SAFETY: the layout's handoff region, which `Layout::checked` holds to be RAM of that size
        // and which the linker scripts keep out of every image.
        let reported = unsafe { Handoff::read(layout.handoff.base as usize as *const Handoff) };
        Self::new(reported, defaults)
    }

    /// From what the bootloader passed on, if it did.
    #[must_use]
    pub const fn new(reported: Option<BootInfo>, defaults: Defaults) -> Self {
        match reported {
            Some(info) => Self {
                node_id: Some(info.node_id),
                bit_rate: info.bit_rate,
                serial_number: info.serial_number,
                program: info.program,
                fresh: info.fresh,
                reported,
            },
            None => Self {
                node_id: defaults.node_id,
                bit_rate: defaults.bit_rate,
                serial_number: defaults.serial_number,
                program: 1,
                fresh: false,
                reported,
            },
        }
    }

    /// The sub-index of the bootloader itself in 1F51h, 1F56h and 1F57h; `None` if it cannot be renewed over
    /// CAN, or no bootloader started the program.
    #[must_use]
    pub const fn bootloader_number(&self) -> Option<u8> {
        match self.reported {
            Some(reported) => reported.bootloader_number,
            None => None,
        }
    }

    /// The bases of the COB-IDs of SDO: a client of the bootloader goes on with the program by the same ones.
    /// Those of the predefined connection set if no bootloader started the program.
    #[must_use]
    pub const fn sdo(&self) -> SdoBases {
        match self.reported {
            Some(reported) => reported.sdo,
            None => SdoBases::PREDEFINED,
        }
    }

    /// The two elements of 1F52h (CiA 302-3, verify application software): the date of this program in days since
    /// 1984-01-01, and the time in milliseconds after midnight (UTC). Zeros if neither its block 0 nor its
    /// label has a date, or no bootloader started the program.
    #[must_use]
    pub const fn software_date(&self) -> [u32; 2] {
        match self.reported {
            Some(reported) => days_and_milliseconds(reported.program_date),
            None => [0; 2],
        }
    }

    /// The identity of the device where that is not the one of its board: the bootloader has it from the
    /// one-time programmable bytes (its choice `identity`), and the program must show the same one.
    /// The serial number in use is [`serial_number`](Self::serial_number).
    #[must_use]
    pub fn nameplate(&self) -> Option<Nameplate> {
        self.reported.filter(|reported| reported.nameplate)?;
        // SAFETY: the bootloader has read it there: the program runs on a chip with these bytes.
        unsafe { Nameplate::read(OTP.base as usize as *const Words) }
    }

    /// The node-ID with which the bootloader comes up at the same bit rate, so that it can answer in
    /// this program's place. `None` where it has to find the bit rate out first.
    #[must_use]
    pub const fn bootloader_node(&self) -> Option<u8> {
        match self.bit_rate {
            0 => None,
            _ => self.node_id,
        }
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::handoff::ResetCause;

    use super::*;

    const DEFAULTS: Defaults = Defaults { node_id: Some(32), bit_rate: 125_000, serial_number: 7 };
    const TOLD: BootInfo = BootInfo {
        node_id: 5,
        bit_rate: 500_000,
        program: 2,
        reset_cause: ResetCause::PowerOn,
        trial: true,
        fresh: true,
        bootloader_version: 0x0001_0000,
        serial_number: 9,
        bootloader_number: None,
        sdo: SdoBases { request: 0x680, response: 0x480 },
        // 2026-11-27 18:30:15.
        program_date: 1_795_804_215,
        nameplate: false,
    };

    #[test]
    fn what_the_bootloader_told_comes_before_the_defaults() {
        let Start { node_id, bit_rate, serial_number, program, fresh, reported } =
            Start::new(Some(TOLD), DEFAULTS);
        assert_eq!((node_id, bit_rate, serial_number, program), (Some(5), 500_000, 9, 2));
        assert!(fresh && reported == Some(TOLD));
        let start = Start::new(None, DEFAULTS);
        assert_eq!((start.node_id, start.bit_rate, start.serial_number), (Some(32), 125_000, 7));
        assert_eq!((start.program, start.fresh, start.reported), (1, false, None));
        assert_eq!(start.sdo(), SdoBases { request: 0x600, response: 0x580 });
        assert_eq!(Start::new(Some(TOLD), DEFAULTS).sdo(), TOLD.sdo);
        assert_eq!(start.software_date(), [0, 0]);
        assert_eq!(Start::new(Some(TOLD), DEFAULTS).software_date(), [15_671, 66_615_000]);
        // Nothing is read where the bootloader does not look.
        assert_eq!((start.nameplate(), Start::new(Some(TOLD), DEFAULTS).nameplate()), (None, None));
    }

    #[test]
    fn a_bootloader_that_has_to_listen_first_does_not_answer() {
        assert_eq!(Start::new(Some(TOLD), DEFAULTS).bootloader_node(), Some(5));
        let listens = BootInfo { bit_rate: 0, ..TOLD };
        assert_eq!(Start::new(Some(listens), DEFAULTS).bootloader_node(), None);
        assert_eq!(Start::new(None, Defaults { node_id: None, ..DEFAULTS }).bootloader_node(), None);
    }
}
