//! The acceptance filters: 28 banks shared by CAN1 and CAN2 (RM0090, 32.7.4 "Identifier
//! filtering").

use crate::frame::{Frame, Id};
use crate::peripheral::{unmodelled, Unmodelled};

/// Banks of the dual bxCAN.
pub const BANKS: usize = 28;
const ALL_BANKS: u32 = (1 << BANKS) - 1;
/// FMR after a reset: 14 banks for CAN1, initialisation mode, and reserved bits that read as they
/// are.
const FMR_RESET: u32 = 0x2A1C_0E01;
const FINIT: u32 = 1;
const CAN2SB: u32 = 0x3F << 8;

/// The place of a frame that a filter lets through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Match {
    /// FIFO 0 or 1.
    pub fifo: usize,
    /// Filter match index: the number of the filter among those of this FIFO.
    pub index: u8,
}

/// The controller that a bank belongs to: banks below CAN2SB belong to CAN1, those from it on to
/// CAN2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Share {
    /// The master's.
    Can1,
    /// The slave's.
    Can2,
}

/// The filter registers.
#[derive(Clone, Debug)]
pub struct Filters {
    fmr: u32,
    /// FM1R: identifier list (1) or mask (0).
    list: u32,
    /// FS1R: one 32-bit filter (1) or two 16-bit ones (0).
    wide: u32,
    /// FFA1R: FIFO 1 or 0.
    fifo: u32,
    /// FA1R: active.
    active: u32,
    banks: [[u32; 2]; BANKS],
}

/// The kind of a bank: how it compares identifiers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Mask16,
    List16,
    Mask32,
    List32,
}

impl Kind {
    /// Filters that a bank of this kind holds, each with a number of its own.
    fn filters(self) -> u8 {
        match self {
            Self::Mask32 => 1,
            Self::List32 | Self::Mask16 => 2,
            Self::List16 => 4,
        }
    }

    /// Which filter wins where several match: 32 bits over 16, list over mask.
    fn priority(self) -> u8 {
        match self {
            Self::Mask16 => 0,
            Self::List16 => 1,
            Self::Mask32 => 2,
            Self::List32 => 3,
        }
    }
}

impl Default for Filters {
    fn default() -> Self {
        Self { fmr: FMR_RESET, list: 0, wide: 0, fifo: 0, active: 0, banks: [[0; 2]; BANKS] }
    }
}

/// The identifier as a 32-bit filter sees it: STID[10:0], EXID[17:0], IDE, RTR, 0.
fn wide_word(frame: &Frame) -> u32 {
    let remote = u32::from(frame.is_remote()) << 1;
    match frame.id() {
        Id::Standard(id) => u32::from(id.as_raw()) << 21 | remote,
        Id::Extended(id) => id.as_raw() << 3 | 1 << 2 | remote,
    }
}

/// The identifier as a 16-bit filter sees it: STID[10:0], RTR, IDE, EXID[17:15].
fn narrow_word(frame: &Frame) -> u16 {
    let remote = u16::from(frame.is_remote()) << 4;
    match frame.id() {
        Id::Standard(id) => id.as_raw() << 5 | remote,
        Id::Extended(id) => {
            let (base, high) = (id.as_raw() >> 18 & 0x7FF, id.as_raw() >> 15 & 7);
            // Both fit their fields by the masks above.
            (base as u16) << 5 | remote | 1 << 3 | high as u16
        }
    }
}

impl Filters {
    /// Reads the register at `offset` of the CAN block.
    pub fn read(&self, offset: u32) -> Result<u32, Unmodelled> {
        Ok(match offset {
            0x200 => self.fmr,
            0x204 => self.list,
            0x20C => self.wide,
            0x214 => self.fifo,
            0x21C => self.active,
            _ => {
                let (bank, half) = bank(offset)?;
                self.banks[bank][half]
            }
        })
    }

    /// Writes the register at `offset` of the CAN block. A write that the hardware ignores is
    /// returned as an error.
    pub fn write(&mut self, offset: u32, value: u32) -> Result<(), Unmodelled> {
        let configuration = |name: &str| {
            if self.fmr & FINIT != 0 {
                Ok(value & ALL_BANKS)
            } else {
                unmodelled(format!("{name} is written while FMR.FINIT is clear: the write has no effect"))
            }
        };
        match offset {
            0x200 => self.fmr = FMR_RESET & !(FINIT | CAN2SB) | value & (FINIT | CAN2SB),
            0x204 => self.list = configuration("FM1R")?,
            0x20C => self.wide = configuration("FS1R")?,
            0x214 => self.fifo = configuration("FFA1R")?,
            0x21C => self.active = value & ALL_BANKS,
            _ => {
                let (bank, half) = bank(offset)?;
                if self.fmr & FINIT == 0 && self.active >> bank & 1 == 1 {
                    return unmodelled(format!(
                        "filter bank {bank} is written while it is active and FMR.FINIT is clear: the write has no effect"
                    ));
                }
                self.banks[bank][half] = value;
            }
        }
        Ok(())
    }

    fn kind(&self, bank: usize) -> Kind {
        match (self.wide >> bank & 1, self.list >> bank & 1) {
            (0, 0) => Kind::Mask16,
            (0, _) => Kind::List16,
            (_, 0) => Kind::Mask32,
            _ => Kind::List32,
        }
    }

    /// The filter of `bank` that lets the frame through, counted from the bank's first.
    fn hit(&self, bank: usize, frame: &Frame) -> Option<u8> {
        let [first, second] = self.banks[bank];
        let halves = |word: u32| [word as u16, (word >> 16) as u16];
        let narrow = narrow_word(frame);
        // Bit 0 of a 32-bit filter is not part of the comparison.
        let wide = wide_word(frame);
        let position = |matches: &[bool]| matches.iter().position(|&hit| hit).map(|n| n as u8);
        match self.kind(bank) {
            Kind::Mask32 => position(&[(wide ^ first) & second & !1 == 0]),
            Kind::List32 => position(&[(wide ^ first) & !1 == 0, (wide ^ second) & !1 == 0]),
            Kind::Mask16 => {
                position(&[first, second].map(halves).map(|[id, mask]| (narrow ^ id) & mask == 0))
            }
            Kind::List16 => {
                let ([a, b], [c, d]) = (halves(first), halves(second));
                position(&[a, b, c, d].map(|id| id == narrow))
            }
        }
    }

    /// Where a controller puts the frame; `None` if no filter of its share lets it through or the
    /// filters are being set up. Filters are numbered from the first bank of the share on; the
    /// manual's example is one of CAN1 alone.
    #[must_use]
    pub fn accept(&self, share: Share, frame: &Frame) -> Option<Match> {
        if self.fmr & FINIT != 0 {
            return None;
        }
        let start = (((self.fmr & CAN2SB) >> 8) as usize).min(BANKS);
        let banks = match share {
            Share::Can1 => 0..start,
            Share::Can2 => start..BANKS,
        };
        let mut next_index = [0u8; 2];
        let mut best: Option<(u8, Match)> = None;
        for bank in banks {
            let kind = self.kind(bank);
            let fifo = (self.fifo >> bank & 1) as usize;
            // A bank keeps its numbers whether it is active or not.
            let base = next_index[fifo];
            next_index[fifo] += kind.filters();
            if self.active >> bank & 1 == 0 {
                continue;
            }
            if let Some(n) = self.hit(bank, frame) {
                if best.is_none_or(|(priority, _)| kind.priority() > priority) {
                    best = Some((kind.priority(), Match { fifo, index: base + n }));
                }
            }
        }
        best.map(|(_, found)| found)
    }
}

/// Bank and half of the register FiRx at `offset`.
fn bank(offset: u32) -> Result<(usize, usize), Unmodelled> {
    let word = offset.checked_sub(0x240).map(|n| (n / 4) as usize);
    match word {
        Some(word) if word < 2 * BANKS && offset.is_multiple_of(4) => Ok((word / 2, word % 2)),
        _ => unmodelled(format!("no filter register at offset {offset:#x}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::StandardId;

    const FMR: u32 = 0x200;
    const FM1R: u32 = 0x204;
    const FS1R: u32 = 0x20C;
    const FFA1R: u32 = 0x214;
    const FA1R: u32 = 0x21C;

    fn standard(id: u16) -> Frame {
        Frame::standard(id, &[]).unwrap()
    }

    fn remote(id: u16) -> Frame {
        Frame::remote_frame(Id::Standard(StandardId::new(id).unwrap()), 0).unwrap()
    }

    fn extended(id: u32) -> Frame {
        Frame::extended(id, &[]).unwrap()
    }

    fn one_bank(list: u32, wide: u32, registers: [u32; 2]) -> Filters {
        let mut filters = Filters::default();
        for (offset, value) in [
            (FM1R, list),
            (FS1R, wide),
            (0x240, registers[0]),
            (0x244, registers[1]),
            (FA1R, 1),
            (FMR, 14 << 8),
        ] {
            filters.write(offset, value).unwrap();
        }
        filters
    }

    fn index(filters: &Filters, frame: &Frame) -> Option<u8> {
        filters.accept(Share::Can1, frame).map(|found| found.index)
    }

    #[test]
    fn reset_values_and_nothing_received_while_set_up() {
        let mut filters = Filters::default();
        assert_eq!(filters.read(FMR), Ok(0x2A1C_0E01));
        assert_eq!(filters.read(FA1R), Ok(0));
        filters.write(FS1R, 1).unwrap();
        filters.write(FA1R, 1).unwrap();
        assert_eq!(filters.accept(Share::Can1, &standard(1)), None, "FINIT is set");
        filters.write(FMR, 0x2A1C_0E00).unwrap();
        assert_eq!(index(&filters, &standard(1)), Some(0), "mask 0 lets everything through");
        filters.write(FA1R, 0).unwrap();
        assert_eq!(filters.accept(Share::Can1, &standard(1)), None, "no active bank");
    }

    #[test]
    fn mask_of_32_bits() {
        // 601h and 29-bit 0C040000h..: STID at 31..21. Mask: the STID's bits and IDE.
        let filters = one_bank(0, 1, [0x601 << 21, 0x7FF << 21 | 1 << 2]);
        assert_eq!(index(&filters, &standard(0x601)), Some(0));
        assert_eq!(index(&filters, &remote(0x601)), Some(0), "RTR is not in the mask");
        assert_eq!(index(&filters, &standard(0x602)), None);
        assert_eq!(index(&filters, &extended(0x601 << 18)), None, "IDE is in the mask");
        // EXID[17:0] at 20..3, all compared.
        let filters = one_bank(0, 1, [0x1234_5678 << 3 | 1 << 2, 0xFFFF_FFFE]);
        assert_eq!(index(&filters, &extended(0x1234_5678)), Some(0));
        assert_eq!(index(&filters, &extended(0x1234_5679)), None);
    }

    #[test]
    fn list_of_32_bits() {
        let filters = one_bank(1, 1, [0x601 << 21 | 1 << 1, 0x1ABC_DEF0 << 3 | 1 << 2]);
        assert_eq!(index(&filters, &remote(0x601)), Some(0));
        assert_eq!(index(&filters, &standard(0x601)), None);
        assert_eq!(index(&filters, &extended(0x1ABC_DEF0)), Some(1));
    }

    #[test]
    fn mask_of_16_bits() {
        // Low half identifier, high half mask: STID 15..5, RTR 4, IDE 3, EXID[17:15] 2..0.
        let filters = one_bank(0, 0, [0x700 << 5 | (0x780 << 5 | 1 << 4) << 16, 0x000F | 0x000F << 16]);
        assert_eq!(index(&filters, &standard(0x77F)), Some(0));
        assert_eq!(index(&filters, &remote(0x77F)), None);
        assert_eq!(index(&filters, &standard(0x67F)), None);
        assert_eq!(index(&filters, &extended(0x0003_8000)), Some(1), "EXID[17:15] = 111 and IDE");
        assert_eq!(index(&filters, &extended(0x0003_0000)), None);
    }

    #[test]
    fn list_of_16_bits() {
        let filters =
            one_bank(1, 0, [0x081 << 5 | (0x181 << 5) << 16, (0x601 << 5 | 1 << 4) | (0x701 << 5) << 16]);
        assert_eq!(index(&filters, &standard(0x081)), Some(0));
        assert_eq!(index(&filters, &standard(0x181)), Some(1));
        assert_eq!(index(&filters, &standard(0x601)), None);
        assert_eq!(index(&filters, &remote(0x601)), Some(2));
        assert_eq!(index(&filters, &standard(0x701)), Some(3));
    }

    /// RM0090, 32.7.4, figure "Example of filter numbering".
    #[test]
    fn numbers_of_the_manuals_example() {
        use Kind::{List16, List32, Mask16, Mask32};
        // Bank, FIFO, kind, active, first number.
        let example = [
            (0, 0, List32, true, 0),
            (1, 0, Mask32, true, 2),
            (2, 1, Mask16, true, 0),
            (3, 0, List16, true, 3),
            (4, 1, List32, true, 2),
            (5, 0, List32, false, 7),
            (6, 0, Mask16, true, 9),
            (7, 1, Mask16, false, 4),
            (8, 1, Mask16, true, 6),
            (9, 0, List32, true, 11),
            (10, 1, List16, false, 8),
            (11, 1, List32, true, 12),
            (12, 1, Mask32, true, 14),
            (13, 0, Mask32, true, 13),
        ];
        let mut filters = Filters::default();
        let (mut list, mut wide, mut fifo1, mut active) = (0, 0, 0, 0);
        for (bank, fifo, kind, is_active, _) in example {
            let id = 0x100 + bank;
            let (first, second) = match kind {
                List32 => (id << 21, 0x7FF << 21),
                Mask32 => (id << 21, 0xFFFF_FFFE),
                List16 => (id << 5 | 0x7FF << 21, 0x7FF << 5 | 0x7FF << 21),
                Mask16 => (id << 5 | 0xFFFF << 16, 0x7FF << 5 | 0xFFFF << 16),
            };
            list |= u32::from(matches!(kind, List16 | List32)) << bank;
            wide |= u32::from(matches!(kind, Mask32 | List32)) << bank;
            fifo1 |= fifo << bank;
            active |= u32::from(is_active) << bank;
            filters.write(0x240 + 8 * bank, first).unwrap();
            filters.write(0x244 + 8 * bank, second).unwrap();
        }
        for (offset, value) in [(FM1R, list), (FS1R, wide), (FFA1R, fifo1), (FA1R, active), (FMR, 14 << 8)] {
            filters.write(offset, value).unwrap();
        }
        for (bank, fifo, _, is_active, number) in example {
            let expected = is_active.then_some(Match { fifo: fifo as usize, index: number });
            assert_eq!(filters.accept(Share::Can1, &standard(0x100 + bank as u16)), expected, "bank {bank}");
        }
    }

    #[test]
    fn wider_then_list_then_lower_number_wins() {
        let mut filters = Filters::default();
        // Banks 0 and 1: 16-bit mask, let everything through, bank 1 to FIFO 1. Bank 2: 16-bit
        // list. Bank 3: 32-bit mask.
        filters.write(FFA1R, 0b0010).unwrap();
        filters.write(FM1R, 0b0100).unwrap();
        filters.write(FS1R, 0b1000).unwrap();
        filters.write(0x250, 0x123 << 5).unwrap();
        filters.write(0x258, 0x123 << 21).unwrap();
        filters.write(0x25C, 0xFFFF_FFFE).unwrap();
        filters.write(FMR, 28 << 8).unwrap();
        let mut accept = |active, id| {
            filters.write(FA1R, active).unwrap();
            filters.accept(Share::Can1, &standard(id)).map(|found| (found.fifo, found.index))
        };
        // Numbers in FIFO 0: bank 0 has 0, 1; bank 2 has 2 to 5; bank 3 has 6.
        assert_eq!(accept(0b1111, 0x123), Some((0, 6)));
        assert_eq!(accept(0b0111, 0x123), Some((0, 2)));
        assert_eq!(accept(0b0011, 0x123), Some((0, 0)));
        assert_eq!(accept(0b0010, 0x123), Some((1, 0)));
        assert_eq!(accept(0b1111, 0x124), Some((0, 0)));
    }

    /// CAN2SB "defines the start bank for the CAN2 interface (slave)" (RM0090, 32.9.4): the bank of
    /// this number is the slave's, the one before it the master's.
    #[test]
    fn can2sb_is_the_border_of_the_shares() {
        let mut filters = Filters::default();
        // Banks 13 and 14: 16-bit lists of 081h and 181h, bank 14 to FIFO 1.
        for (offset, value) in [
            (FM1R, 3 << 13),
            (FFA1R, 1 << 14),
            (0x240 + 8 * 13, 0x081 << 5 | (0x081 << 5) << 16),
            (0x244 + 8 * 13, 0x081 << 5 | (0x081 << 5) << 16),
            (0x240 + 8 * 14, 0x181 << 5 | (0x181 << 5) << 16),
            (0x244 + 8 * 14, 0x181 << 5 | (0x181 << 5) << 16),
            (FA1R, 3 << 13),
        ] {
            filters.write(offset, value).unwrap();
        }
        let mut taken = |can2sb: u32| {
            filters.write(FMR, can2sb << 8).unwrap();
            let by = |share, id| filters.accept(share, &standard(id)).map(|found| found.fifo);
            [by(Share::Can1, 0x081), by(Share::Can1, 0x181), by(Share::Can2, 0x081), by(Share::Can2, 0x181)]
        };
        assert_eq!(taken(14), [Some(0), None, None, Some(1)], "the value after a reset");
        assert_eq!(taken(15), [Some(0), Some(1), None, None]);
        assert_eq!(taken(13), [None, None, Some(0), Some(1)]);
        assert_eq!(taken(0), [None, None, Some(0), Some(1)], "every bank is CAN2's");
        assert_eq!(taken(28), [Some(0), Some(1), None, None], "CAN2 has none");
        assert_eq!(taken(0x3F), [Some(0), Some(1), None, None], "there are no more than 28");
    }

    #[test]
    fn set_up_of_the_filters_stops_both_controllers() {
        let mut filters = Filters::default();
        filters.write(FA1R, 1 << 13 | 1 << 14).unwrap();
        filters.write(FMR, 14 << 8 | 1).unwrap();
        assert_eq!(filters.accept(Share::Can1, &standard(1)), None);
        assert_eq!(filters.accept(Share::Can2, &standard(1)), None);
        filters.write(FMR, 14 << 8).unwrap();
        assert!(filters.accept(Share::Can1, &standard(1)).is_some());
        assert!(filters.accept(Share::Can2, &standard(1)).is_some());
    }

    #[test]
    fn protected_registers_stay() {
        let mut filters = one_bank(0, 1, [7 << 21, 0]);
        for offset in [FM1R, FS1R, FFA1R, 0x240, 0x244] {
            assert!(filters.write(offset, u32::MAX).is_err(), "{offset:#x}");
        }
        assert_eq!(filters.read(FM1R), Ok(0));
        assert_eq!(filters.read(0x240), Ok(7 << 21));
        filters.write(FA1R, 0).unwrap();
        filters.write(0x240, 8 << 21).unwrap();
        assert_eq!(filters.read(0x31C), Ok(0), "F27R2 is the last one");
        for offset in [0x208, 0x210, 0x218, 0x220, 0x320, 0x23C] {
            assert!(filters.read(offset).is_err() && filters.write(offset, 0).is_err(), "{offset:#x}");
        }
    }
}
