//! The option bytes of a device in words: 2007h/6 of coboot, which is the chip's FLASH_OPTCR.

use std::fmt;

use serde::{Serialize, Serializer};

/// The option bytes as FLASH_OPTCR has them (RM0090 section 3.9.10). `Display` shows them in one line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OptionBytes(pub u32);

impl OptionBytes {
    /// Those of a chip from the factory (RM0090 section 3.9.10), with this level of the brown-out reset, 1 to 3, and
    /// with write protection of these sectors of the first bank: bit *n* for sector *n*.
    #[must_use]
    pub const fn of_product(brown_out_level: u32, protect: u32) -> Self {
        Self(0x0FFF_AAED & !(brown_out_level << 2) & !(protect << 16))
    }

    /// A text for the production line: the commands that write them by three programmers. `chip` is the name for
    /// probe-rs. OpenOCD and probe-rs do it by registers, as RM0090 section 3.6.2 has it.
    #[must_use]
    pub fn commands(self, chip: &str) -> String {
        const OPTKEYR: u32 = 0x4002_3C08;
        const OPTCR: u32 = 0x4002_3C14;
        let Self(value) = self;
        // With OPTLOCK (bit 0) cleared; OPTSTRT (bit 1) begins.
        let words = [
            (OPTKEYR, 0x0819_2A3B),
            (OPTKEYR, 0x4C5D_6E7F),
            (OPTCR, value & !0b11),
            (OPTCR, value & !0b11 | 0b10),
        ];
        let protected =
            (0..12).filter(|sector| self.protects(*sector)).map(|sector| format!(" nWRP{sector}=0"));
        let openocd = words.map(|(at, word)| format!("mww {at:#010x} {word:#010x}; ")).concat();
        let probe_rs =
            words.map(|(at, word)| format!("probe-rs write --chip {chip} b32 {at:#010x} {word:#010x}\n"));
        format!(
            "# Option bytes: {self}\n# Once the flash is written and compared, by ONE of the three; then a power cycle. \
             Read-out protection comes last, and by hand.\n\n# STM32CubeProgrammer\nSTM32_Programmer_CLI -c port=SWD \
             -ob BOR_LEV={}{}\n\n# OpenOCD\nopenocd -f interface/stlink.cfg -f target/stm32f4x.cfg -c \"init; reset \
             halt; {openocd}sleep 1000; reset run; exit\"\n\n# probe-rs\n{}",
            value >> 2 & 0b11,
            protected.collect::<String>(),
            probe_rs.concat(),
        )
    }

    /// The level of the brown-out reset, 1 to 3; `None` if it is off.
    #[must_use]
    pub fn brown_out_level(self) -> Option<u8> {
        // BOR_LEV counts down: 00b is level 3, 11b is off.
        match 3 - (self.0 >> 2 & 0b11) as u8 {
            0 => None,
            level => Some(level),
        }
    }

    /// Whether the chip starts from its second bank (BFB2).
    #[must_use]
    pub const fn boots_from_bank_2(self) -> bool {
        self.has(4)
    }

    /// Whether the watchdog starts with each reset (WDG_SW is 0).
    #[must_use]
    pub const fn starts_watchdog(self) -> bool {
        !self.has(5)
    }

    /// Whether nWRP protects against reading, too (SPRMOD).
    #[must_use]
    pub const fn protects_from_reading(self) -> bool {
        self.has(31)
    }

    /// The level of the read-out protection (RDP), 0 to 2.
    #[must_use]
    pub const fn read_out_level(self) -> u8 {
        match (self.0 >> 8) as u8 {
            0xAA => 0,
            0xCC => 2,
            _ => 1,
        }
    }

    /// Whether a sector of the first bank is protected (nWRP), 0 to 11.
    #[must_use]
    pub const fn protects(self, sector: u8) -> bool {
        // A zero protects; with SPRMOD a one does.
        self.has(16 + sector) == self.protects_from_reading()
    }

    /// The protected sectors of the first bank: bit *n* for sector *n*.
    #[must_use]
    pub fn protected(self) -> u32 {
        (0..12).filter(|sector| self.protects(*sector)).fold(0, |mask, sector| mask | 1 << sector)
    }

    const fn has(self, bit: u8) -> bool {
        self.0 >> bit & 1 != 0
    }

    /// What of them is wrong for a product, or needs care: what it means, and what to do.
    #[must_use]
    pub fn warnings(self) -> Vec<&'static str> {
        [
            (
                self.brown_out_level().is_none(),
                "the brown-out reset is off, so that the chip runs on while its supply fails: set BOR_LEV with a \
                 debug probe, to level 3 for a supply of 3.0 V and more, level 2 from 2.7 V, level 1 from 2.4 V",
            ),
            (
                self.protects_from_reading(),
                "SPRMOD is set: nWRP protects against reading, too, and what is protected cannot be checked or \
                 replaced. To take it away erases the chip (read-out protection from level 1 to 0)",
            ),
            (
                !self.protects(0),
                "the bootloader is not write-protected: clear nWRP of sector 0 with a debug probe \
                 (of a board with the compact map sectors 0 and 1), and of no others",
            ),
            (
                self.starts_watchdog(),
                "the watchdog starts with each reset (WDG_SW): a program has to feed it from its first instructions \
                 on, within 349 ms",
            ),
            (
                self.boots_from_bank_2(),
                "BFB2 is set: the chip starts from its second bank if that begins with a stack pointer, and the \
                 bootloader is in the first one. Clear it with a debug probe",
            ),
        ]
        .into_iter()
        .filter_map(|(is_so, warning)| is_so.then_some(warning))
        .collect()
    }
}

/// As the number.
impl Serialize for OptionBytes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u32(self.0)
    }
}

impl fmt::Display for OptionBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.brown_out_level() {
            Some(level) => write!(f, "brown-out reset level {level}")?,
            None => f.write_str("brown-out reset off")?,
        }
        match (self.protected(), self.protects_from_reading()) {
            (0, _) => f.write_str(", no sector protected")?,
            (sectors, false) => write!(f, ", write-protected: {}", sector_list(sectors))?,
            (sectors, true) => {
                write!(f, ", protected against reading and writing: {}", sector_list(sectors))?
            }
        }
        write!(f, ", read-out protection level {}", self.read_out_level())?;
        if self.starts_watchdog() {
            f.write_str(", hardware watchdog")?;
        }
        if self.boots_from_bank_2() {
            f.write_str(", start from bank 2")?;
        }
        write!(f, " ({:08X}h)", self.0)
    }
}

/// The sectors of a mask, bit *n* for sector *n*, as a list.
#[must_use]
pub fn sector_list(mask: u32) -> String {
    let sectors: Vec<_> = (0..32).filter(|sector| mask >> sector & 1 != 0).map(|n| n.to_string()).collect();
    match sectors.as_slice() {
        [] => "no sector".to_string(),
        [one] => format!("sector {one}"),
        sectors => format!("sectors {}", sectors.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// RM0090 section 3.9.10: the value after a reset of a chip from the factory, and each field.
    #[test]
    fn each_field_has_its_words() {
        for (value, words) in [
            (0x0FFF_AAED, "brown-out reset off, no sector protected, read-out protection level 0 (0FFFAAEDh)"),
            (
                0x0FEE_AAE1,
                "brown-out reset level 3, write-protected: sectors 0, 4, read-out protection level 0 (0FEEAAE1h)",
            ),
            (0x0FFF_AAE5, "brown-out reset level 2, no sector protected, read-out protection level 0 (0FFFAAE5h)"),
            (0x0FFF_55E9, "brown-out reset level 1, no sector protected, read-out protection level 1 (0FFF55E9h)"),
            (
                0x0FFF_CCCD,
                "brown-out reset off, no sector protected, read-out protection level 2, hardware watchdog (0FFFCCCDh)",
            ),
            (
                0x8001_AAFD,
                "brown-out reset off, protected against reading and writing: sector 0, read-out protection level 0, \
                 start from bank 2 (8001AAFDh)",
            ),
        ] {
            assert_eq!(OptionBytes(value).to_string(), words);
        }
    }

    /// The numbers of the test before.
    #[test]
    fn those_of_a_product_are_the_factorys_with_two_fields() {
        assert_eq!(OptionBytes::of_product(3, 0b1_0001), OptionBytes(0x0FEE_AAE1));
        assert_eq!(OptionBytes::of_product(2, 0), OptionBytes(0x0FFF_AAE5));
    }

    #[test]
    fn what_is_wrong_for_a_product_is_told_with_the_cure() {
        let reported = |value, words: &[&str]| {
            let warnings = OptionBytes(value).warnings();
            assert_eq!(warnings.len(), words.len(), "{value:08X}h: {warnings:?}");
            for (warning, word) in warnings.iter().zip(words) {
                assert!(warning.contains(word), "{value:08X}h: {warning}");
            }
        };
        // Level 3 and sector 0 protected, all the same what else is protected.
        reported(0x0FFE_AAE1, &[]);
        reported(0x0000_CCE1, &[]);
        reported(0x0FFF_AAED, &["brown-out reset is off", "not write-protected"]);
        reported(0x0FFE_AAED, &["brown-out reset is off"]);
        // Sector 4 alone.
        reported(0x0FEF_AAE1, &["not write-protected"]);
        reported(0x0FFE_AAC1, &["within 349 ms"]);
        reported(0x0FFE_AAF1, &["BFB2"]);
        reported(0x8001_AAE1, &["SPRMOD"]);
        reported(0x8000_AACD, &["brown-out", "SPRMOD", "not write-protected", "watchdog"]);
    }
}
