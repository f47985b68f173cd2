//! The differences between the lines of the family beside those in `shared_abi::geometry`: the
//! registers and bits that exist, and the identification values.

use shared_abi::geometry::{Geometry, Line};

/// A register of RCC that is kept as written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plain {
    /// Its offset.
    pub at: u32,
    /// Its value, at first that after a reset.
    pub value: u32,
    /// Its value after a reset.
    pub reset: u32,
    /// The bits that exist.
    pub bits: u32,
}

/// One line of the family.
#[derive(Debug, PartialEq, Eq)]
pub struct Variant {
    /// The name of the chips in reports.
    pub name: &'static str,
    /// DBGMCU_IDCODE: device and revision.
    pub idcode: u32,
    /// PWR_CR.VOS, and its value after a reset.
    pub voltage_scale: (u32, u32),
    /// Its column of [`RCC`].
    column: usize,
}

impl Variant {
    /// Whether the regulator has over-drive, for 180 MHz: F42x, F43x, F446, F469 and F479.
    #[must_use]
    pub fn has_over_drive(&self) -> bool {
        self.column >= F429.column
    }

    /// The registers of RCC that are kept as written, after a reset.
    pub fn rcc(&self) -> impl Iterator<Item = Plain> + '_ {
        RCC.iter().filter_map(|(at, reset, columns)| {
            let bits = columns[self.column]?;
            let reset = reset.unwrap_or(bits);
            Some(Plain { at: *at, value: reset, reset, bits })
        })
    }
}

/// A row of [`RCC`]: the offset of a register, its value after a reset (nothing: all bits that exist are 1), and
/// those bits on each line that has the register.
type Row = (u32, Option<u32>, [Option<u32>; 6]);

macro_rules! rows {
    ($($at:literal $reset:tt: $($bits:tt),*;)*) => {
        &[$(($at, rows!(@ $reset), [$(rows!(@ $bits)),*]),)*]
    };
    (@ -) => { None };
    (@ all) => { None };
    (@ $value:literal) => { Some($value) };
}

/// The plain registers of RCC: RM0090 sections 6 (F42x, F43x) and 7 (F405 to F417); for the other lines reset values
/// and bits as the PAC has them. Bit 20 of AHB1ENR, on some lines the clock of the CCM RAM, is set after a reset on all,
/// as the PAC has it. The F407 has no DCKCFGR, but programs for the whole family read it, and look for TIMPRE.
#[rustfmt::skip]
const RCC: &[Row] = rows! {
    // at  reset              F407         F412         F413         F429         F446         F469
    0x04 0x2400_3010: 0x0F43_7FFF, 0x7F43_7FFF, 0x7F43_7FFF, 0x0F43_7FFF, 0x7F43_7FFF, 0x7F43_7FFF; // PLLCFGR
    0x10           0: 0x2260_11FF, 0x0060_10FF, 0x0060_10FF, 0x22E0_17FF, 0x2060_10FF, 0x22E0_17FF; // AHB1RSTR
    0x14           0: 0x0000_00F1, 0x0000_00C0, 0x0000_00D0, 0x0000_00F1, 0x0000_0081, 0x0000_00F1; // AHB2RSTR
    0x18           0: 0x0000_0001, 0x0000_0003, 0x0000_0003, 0x0000_0001, 0x0000_0003, 0x0000_0003; // AHB3RSTR
    0x20           0: 0x36FE_C9FF, 0x17E6_C9FF, 0xFFFE_CBFF, 0xF6FE_C9FF, 0x37FF_C9FF, 0xF6FE_C9FF; // APB1RSTR
    0x24           0: 0x0007_5933, 0x0117_7933, 0x0357_79F3, 0x0477_7933, 0x00C7_7933, 0x0C77_7933; // APB2RSTR
    0x30 0x0010_0000: 0x7E74_11FF, 0x0070_10FF, 0x0070_10FF, 0x7EF4_17FF, 0x6074_10FF, 0x7EF4_17FF; // AHB1ENR
    0x34           0: 0x0000_00F1, 0x0000_00C0, 0x0000_00D0, 0x0000_00F1, 0x0000_0081, 0x0000_00F1; // AHB2ENR
    0x38           0: 0x0000_0001, 0x0000_0003, 0x0000_0003, 0x0000_0001, 0x0000_0003, 0x0000_0003; // AHB3ENR
    0x40           0: 0x36FE_C9FF, 0x17E6_CDFF, 0xFFFE_CFFF, 0xF6FE_C9FF, 0x3FFF_C9FF, 0xF6FE_C9FF; // APB1ENR
    0x44           0: 0x0007_5F33, 0x0117_F933, 0x0357_F9F3, 0x0477_7F33, 0x00C7_7F33, 0x0C77_7F33; // APB2ENR
    0x50         all: 0x7E67_91FF, 0x0061_90FF, 0x0063_90FF, 0x7EEF_97FF, 0x6067_90FF, 0x7EEF_97FF; // AHB1LPENR
    0x54         all: 0x0000_00F1, 0x0000_00C0, 0x0000_00D0, 0x0000_00F1, 0x0000_0081, 0x0000_00F1; // AHB2LPENR
    0x58         all: 0x0000_0001, 0x0000_0003, 0x0000_0003, 0x0000_0001, 0x0000_0003, 0x0000_0003; // AHB3LPENR
    0x60         all: 0x36FE_C9FF, 0x17E6_CDFF, 0xFFFE_CFFF, 0xF6FE_C9FF, 0x3FFF_C9FF, 0xF6FE_C9FF; // APB1LPENR
    0x64         all: 0x0007_5F33, 0x0117_F933, 0x0357_F9F3, 0x0477_7F33, 0x00C7_7F33, 0x0C77_7F33; // APB2LPENR
    0x80           0: 0xFFFF_FFFF, 0xFFFF_FFFF, 0xFFFF_FFFF, 0xFFFF_FFFF, 0xFFFF_FFFF, 0xFFFF_FFFF; // SSCGR
    0x84 0x2000_3000: 0x7000_7FC0,           -,           -, 0x7F00_7FC0,           -, 0x7F00_7FC0; // PLLI2SCFGR
    0x84 0x2400_3000:           -, 0x7F40_7FFF, 0x7F40_7FFF,           -, 0x7F03_7FFF,           -; // PLLI2SCFGR
    0x88 0x2400_3000:           -,           -,           -, 0x7F03_7FC0, 0x7F03_7FFF, 0x7F03_7FC0; // PLLSAICFGR
    0x8C           0: 0x0000_0000, 0x9F00_8000, 0x9FF0_DF1F, 0x01F3_1F1F, 0x1FF0_1F1F, 0x39F3_1F1F; // DCKCFGR
    0x90           0:           -, 0x0000_00FF, 0x0000_00FF,           -, 0x0000_007F,           -; // CKGATENR
    0x94           0:           -, 0x18C0_0000, 0xD8C0_0000,           -, 0x3CC0_0000,           -; // DCKCFGR2
};

/// STM32F405/407/415/417, device 413h, revision Y (RM0090 section 38.6.1).
static F407: Variant =
    Variant { name: "STM32F407", idcode: 0x100F_6413, voltage_scale: (1 << 14, 1 << 14), column: 0 };

/// STM32F412, device 441h, revision C (RM0402 section 30.6.1). A reset leaves the regulator at scale 2
/// (RM0402, PWR_CR).
static F412: Variant =
    Variant { name: "STM32F412", idcode: 0x3000_6441, voltage_scale: (3 << 14, 2 << 14), column: 1 };

/// STM32F413/423, device 463h, revision A (RM0430, DBGMCU_IDCODE). As for the F412.
static F413: Variant =
    Variant { name: "STM32F413", idcode: 0x1000_6463, voltage_scale: (3 << 14, 2 << 14), column: 2 };

/// STM32F42x/43x, device 419h, revision 3 (RM0090 section 38.6.1).
static F429: Variant =
    Variant { name: "STM32F429", idcode: 0x2001_6419, voltage_scale: (3 << 14, 3 << 14), column: 3 };

/// STM32F446, device 421h, revision A (RM0390, DBGMCU_IDCODE).
static F446: Variant =
    Variant { name: "STM32F446", idcode: 0x1000_6421, voltage_scale: (3 << 14, 3 << 14), column: 4 };

/// STM32F469/479, device 434h, revision A (RM0386, DBGMCU_IDCODE).
static F469: Variant =
    Variant { name: "STM32F469", idcode: 0x1000_6434, voltage_scale: (3 << 14, 3 << 14), column: 5 };

/// The variant of a chip.
#[must_use]
pub fn of(chip: &Geometry) -> &'static Variant {
    match chip.line {
        Line::F405 | Line::F407 | Line::F415 | Line::F417 => &F407,
        Line::F412 => &F412,
        Line::F413 | Line::F423 => &F413,
        Line::F427 | Line::F429 | Line::F437 | Line::F439 => &F429,
        Line::F446 => &F446,
        Line::F469 | Line::F479 => &F469,
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::{Line, CHIPS};

    use super::*;

    /// Device identifiers: RM0090 section 38.6.1, RM0402, RM0430, RM0390 and RM0386, DBGMCU_IDCODE.
    #[test]
    fn each_chip_has_its_own() {
        for chip in CHIPS {
            let device = match &chip.chip[7..9] {
                "05" | "07" | "15" | "17" => 0x413,
                "27" | "29" | "37" | "39" => 0x419,
                "46" => 0x421,
                "69" | "79" => 0x434,
                "12" => 0x441,
                "13" | "23" => 0x463,
                other => panic!("{other}"),
            };
            assert_eq!(of(chip).idcode & 0xFFF, device, "{}", chip.chip);
        }
    }

    /// Each line has a port for each bit of AHB1ENR below that of the CRC, and no other.
    #[test]
    fn the_ports_of_a_line_have_clocks() {
        for line in Line::ALL {
            let chip = CHIPS.iter().find(|chip| chip.line == line).expect("every line has a chip");
            let clocks = of(chip).rcc().find(|register| register.at == 0x30).expect("AHB1ENR");
            assert_eq!(clocks.bits & 0xFFF, (1 << chip.ports) - 1, "{}", line.name());
        }
    }

    /// Where a bit resets a block, a bit enables it.
    #[test]
    fn the_reset_bits_of_a_block_have_clocks() {
        for variant in [&F407, &F412, &F413, &F429, &F446, &F469] {
            let mask =
                |offset| variant.rcc().find(|register| register.at == offset).map_or(0, |found| found.bits);
            for reset in [0x10, 0x14, 0x18, 0x20, 0x24] {
                let without = mask(reset) & !mask(reset + 0x20);
                assert_eq!(without, 0, "{}, offset {reset:02X}h", variant.name);
            }
        }
    }
}
