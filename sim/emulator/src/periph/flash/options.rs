//! The option bytes, FLASH_OPTCR and, on a chip with two banks, FLASH_OPTCR1 (RM0090 sections 3.7 and
//! 3.9.9 to 3.9.11).
//!
//! The chip loads the register from the option bytes at reset. A program changes the register, and
//! OPTSTRT erases the option bytes and programs them from it. They are not part of the array: a
//! reset, the loss of power and a mass erase leave them.
//!
//! **Read-out protection.** Level 2 is for good: the option bytes can no longer be changed. Going
//! from level 1 to level 0 erases the whole array (section 3.7.3). From level 1 on a debugger that
//! connects shuts the flash; with level 2 none can. Programs boot from flash here, so that what the
//! levels deny code that booted from elsewhere is not modelled.
//!
//! **Proprietary code read-out protection** (PCROP, section 3.7.5). With SPRMOD a one of nWRP keeps the
//! data bus out of its sector, and code runs from it. Only the way from level 1 to level 0, with its
//! erase, takes the protection back. That section names the STM32F42x and F43x alone; of the other lines ST's HAL says that
//! they have it (`OB_PCROP_SELECTED` in `stm32f4xx_hal_flash_ex.h`), all but the STM32F405, F407, F415 and F417.

use shared_abi::geometry::{Geometry, Line};

use super::lock::Lock;
use crate::peripheral::{unmodelled, Unmodelled};

const KEYS: [u32; 2] = [0x0819_2A3B, 0x4C5D_6E7F];

const OPTLOCK: u32 = 1 << 0;
const OPTSTRT: u32 = 1 << 1;
/// What each chip keeps of a value: nWRP, RDP, the user options, BOR_LEV.
const KEPT: u32 = 0x0FFF_FFEC;
/// The chip boots from the system memory, whose loader starts one of two banks (chips with two).
const BFB2: u32 = 1 << 4;
/// nWRP means protection against reading, too (all but STM32F405, F407, F415 and F417).
const SPRMOD: u32 = 1 << 31;
const NWRP: u32 = 0x0FFF_0000;
/// From the factory: no protection, BOR off, software watchdog (section 3.9.9).
const FACTORY: u32 = 0x0FFF_AAEC;
/// OPTCR1 has nWRP of the second bank. From the factory no sector is protected.
const SECOND: u32 = 0x0FFF_0000;
/// What is left when the power fails while they are programmed: an erased cell reads as 1. That is
/// read-out protection level 1 with no sector protected. Of an STM32F429 it was reported in ST's
/// forum ("STM32F429ZIT6 reset values for flash option bytes when power down", 2018); there the
/// same ones are SPRMOD, too, so that no sector can be read and the part never starts again.
const ERASED: u32 = u32::MAX;

/// RDP of level 0.
const LEVEL_0: u8 = 0xAA;
/// RDP of level 2.
const LEVEL_2: u8 = 0xCC;

/// What a write to FLASH_OPTCR asks of the flash interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Nothing more.
    Done,
    /// The option bytes shall be programmed with this value.
    Program(u32),
    /// The value would take back a protection against reading: WRPERR.
    Protected,
}

/// The option bytes, the register, and its lock.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OptionBytes {
    /// The bits of OPTCR that the chip keeps.
    kept: u32,
    /// What is programmed, as OPTCR and OPTCR1 show it.
    programmed: [u32; 2],
    /// OPTCR and OPTCR1 as written.
    register: [u32; 2],
    lock: Lock,
}

impl Default for OptionBytes {
    fn default() -> Self {
        Self { kept: KEPT, programmed: [FACTORY, SECOND], register: [FACTORY, SECOND], lock: Lock::default() }
    }
}

impl OptionBytes {
    /// Those of a chip as it leaves the factory.
    #[must_use]
    pub fn of(chip: &Geometry) -> Self {
        let sprmod =
            if matches!(chip.line, Line::F405 | Line::F407 | Line::F415 | Line::F417) { 0 } else { SPRMOD };
        let bfb2 = if chip.second_bank.is_some() { BFB2 } else { 0 };
        Self { kept: KEPT | sprmod | bfb2, ..Self::default() }
    }

    /// Takes a write to OPTKEYR.
    ///
    /// # Errors
    /// A wrong key, which the chip answers with a bus error.
    pub fn write_key(&mut self, value: u32) -> Result<(), Unmodelled> {
        self.lock = self.lock.turn(value, KEYS);
        if self.lock == Lock::Barred {
            return unmodelled(
                "wrong key sequence at FLASH_OPTKEYR: FLASH_OPTCR is locked until the next reset, and the chip \
                 answers with a bus error",
            );
        }
        Ok(())
    }

    /// OPTCR as it reads; `programming` while OPTSTRT's work is being done.
    #[must_use]
    pub fn read(&self, programming: bool) -> u32 {
        let lock = if self.lock.is_open() { 0 } else { OPTLOCK };
        self.register[0] | lock | if programming { OPTSTRT } else { 0 }
    }

    /// OPTCR1 as it reads.
    #[must_use]
    pub fn read_second(&self) -> u32 {
        self.register[1]
    }

    /// Takes a write to OPTCR1: a wish until OPTSTRT programs it with the others.
    ///
    /// # Errors
    /// The lock is shut.
    pub fn write_second(&mut self, value: u32) -> Result<(), Unmodelled> {
        if !self.lock.is_open() {
            return unmodelled("FLASH_OPTCR1 is written while it is locked: the chip ignores it");
        }
        self.register[1] = value & SECOND;
        Ok(())
    }

    /// Takes a write to OPTCR.
    ///
    /// # Errors
    /// What the chip does not do, because of the lock or of read-out protection level 2.
    pub fn write(&mut self, value: u32) -> Result<Request, Unmodelled> {
        if !self.lock.is_open() {
            return unmodelled("FLASH_OPTCR is written while it is locked: the chip ignores it");
        }
        self.register[0] = value & self.kept;
        if value & OPTLOCK != 0 {
            self.lock = self.lock.close();
        } else if value & OPTSTRT != 0 {
            if self.level() == 2 {
                return unmodelled(
                    "FLASH_OPTCR.OPTSTRT with read-out protection level 2: the option bytes cannot be changed any \
                     more",
                );
            }
            if self.takes_protection_back() {
                return Ok(Request::Protected);
            }
            return Ok(Request::Program(self.register[0]));
        }
        Ok(Request::Done)
    }

    /// Whether the registers would take SPRMOD or the protection of a sector back, without the erase that goes
    /// with the way to level 0.
    fn takes_protection_back(&self) -> bool {
        let opens = self.level() == 1 && level_of(self.register[0]) == 0;
        let lost = |bank: usize| self.programmed[bank] & !self.register[bank] & NWRP != 0;
        let is_lost = self.register[0] & SPRMOD == 0 || lost(0) || lost(1);
        self.hides_code() && is_lost && !opens
    }

    fn hides_code(&self) -> bool {
        self.programmed[0] & self.kept & SPRMOD != 0
    }

    /// The bit of nWRP of a sector from 0 to 11 of a bank, 0 or 1.
    fn nwrp(&self, bank: usize, sector: u8) -> bool {
        self.programmed[bank] >> 16 & 1 << sector != 0
    }

    /// Whether the data bus is kept out of a sector from 0 to 11 of a bank, 0 or 1.
    #[must_use]
    pub fn hides(&self, bank: usize, sector: u8) -> bool {
        self.hides_code() && self.nwrp(bank, sector)
    }

    /// Whether the chip has the protection against reading.
    #[must_use]
    pub fn may_hide(&self) -> bool {
        self.kept & SPRMOD != 0
    }

    /// BFB2: whether the chip boots from the system memory in place of the flash.
    #[must_use]
    pub fn boots_from_system_memory(&self) -> bool {
        self.programmed[0] & self.kept & BFB2 != 0
    }

    /// The option bytes are programmed. Returns whether that erases the array: read-out protection
    /// went from level 1 to level 0.
    pub fn program(&mut self, value: u32) -> bool {
        let before = self.level();
        self.programmed = [value & self.kept, self.register[1]];
        before == 1 && self.level() == 0
    }

    /// The power fails, or a reset comes, while they are programmed.
    pub fn tear(&mut self) {
        self.programmed = [ERASED & self.kept, SECOND];
    }

    /// A reset: the register is loaded, and locked.
    pub fn reset(&mut self) {
        self.register = self.programmed;
        self.lock = Lock::default();
    }

    /// The level of read-out protection, 0 to 2 (section 3.7.3).
    #[must_use]
    pub fn level(&self) -> u8 {
        level_of(self.programmed[0])
    }

    /// nWRP: a zero protects the sector, with SPRMOD a one (sections 3.7.4 and 3.9.10). For sectors 0 to 11 of a
    /// bank, 0 or 1.
    #[must_use]
    pub fn protects(&self, bank: usize, sector: u8) -> bool {
        self.nwrp(bank, sector) == (self.programmed[0] & SPRMOD != 0)
    }

    /// Sets all of them as a debug probe does, in the form of OPTCR, with bits that some lines alone have.
    pub fn preset_all(&mut self, optcr: u32) {
        self.preset(0, !(OPTLOCK | OPTSTRT), optcr & !(OPTLOCK | OPTSTRT));
    }

    /// Sets nWRP of a sector from 0 to 11 of a bank as a debug probe does: at once, and unnoticed by the running
    /// program.
    pub fn preset_protection(&mut self, bank: usize, sector: u8, protected: bool) {
        let bit = 1 << (16 + sector);
        self.preset(bank, bit, if protected { 0 } else { bit });
    }

    /// Sets RDP as a debug probe does.
    pub fn preset_read_protection(&mut self, rdp: u8) {
        self.preset(0, 0xFF00, u32::from(rdp) << 8);
    }

    /// Sets WDG_SW as a debug probe does: the watchdog starts with each reset.
    pub fn preset_hardware_watchdog(&mut self, on: bool) {
        self.preset(0, 1 << 5, u32::from(!on) << 5);
    }

    /// Sets BOR_LEV as a debug probe does: the level of the brown-out reset, 1 to 3; 0 for off.
    pub fn preset_brown_out_level(&mut self, level: u8) {
        assert!(level <= 3, "there are three levels");
        self.preset(0, 0b11 << 2, u32::from(3 - level) << 2);
    }

    /// BOR_LEV as programmed: 0 to 2 are levels 3 to 1, 3 is off (section 3.9.9).
    #[must_use]
    pub fn brown_out_level(&self) -> u8 {
        (self.programmed[0] >> 2 & 0b11) as u8
    }

    fn preset(&mut self, bank: usize, mask: u32, value: u32) {
        for options in [&mut self.programmed[bank], &mut self.register[bank]] {
            *options = *options & !mask | value;
        }
    }

    /// The sixteen bytes as they read at 1FFF_C000 (section 3.7.1): each value with its complement.
    #[must_use]
    pub fn bytes(&self) -> [u8; 16] {
        let mut bytes = [0xFF; 16];
        let low = self.programmed[0] as u16;
        let high = (self.programmed[0] >> 16 & 0x0FFF) as u16;
        bytes[0..2].copy_from_slice(&low.to_le_bytes());
        bytes[2..4].copy_from_slice(&(!low).to_le_bytes());
        bytes[8..10].copy_from_slice(&high.to_le_bytes());
        bytes[10..12].copy_from_slice(&(!high).to_le_bytes());
        bytes
    }

    /// Option bit nRST_STDBY or nRST_STOP clear: the deep sleep is a reset (section 3.7.1).
    #[must_use]
    pub fn low_power_is_reset(&self, is_standby: bool) -> bool {
        self.programmed[0] & (if is_standby { 1 << 7 } else { 1 << 6 }) == 0
    }

    /// Option bit WDG_SW clear: the watchdog starts by itself after reset (section 3.7.1).
    #[must_use]
    pub fn hardware_watchdog(&self) -> bool {
        self.programmed[0] & 1 << 5 == 0
    }
}

fn level_of(optcr: u32) -> u8 {
    match (optcr >> 8) as u8 {
        LEVEL_0 => 0,
        LEVEL_2 => 2,
        _ => 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared_abi::geometry::{STM32F407VG, STM32F429ZI};

    fn open() -> OptionBytes {
        opened(OptionBytes::default())
    }

    fn opened(mut options: OptionBytes) -> OptionBytes {
        for key in [0x0819_2A3B, 0x4C5D_6E7F] {
            options.write_key(key).unwrap();
        }
        options
    }

    /// RM0090 sections 3.9.9 (reset value 0FFF AAEDh) and 3.7.1.
    #[test]
    fn from_the_factory_nothing_is_protected() {
        let options = OptionBytes::default();
        assert_eq!(options.read(false), 0x0FFF_AAED);
        assert_eq!(options.bytes()[..4], [0xEC, 0xAA, 0x13, 0x55]);
        assert_eq!(options.level(), 0);
        assert!((0..12).all(|sector| !options.protects(0, sector)));
        assert!(!options.hardware_watchdog());
    }

    #[test]
    fn with_sprmod_a_one_protects() {
        let mut options = OptionBytes::default();
        options.preset_all(0x8011_AAEF);
        assert_eq!(options.read(false), 0x8011_AAED, "OPTLOCK is no option, OPTSTRT neither");
        assert!((0..12).filter(|sector| options.protects(0, *sector)).eq([0, 4]));
        for (bits, level) in [(0x0FFF_AAE0, 0), (0x0FFF_AAE4, 1), (0x0FFF_AAE8, 2), (0x0FFF_AAEC, 3)] {
            options.preset_all(bits);
            assert_eq!(options.brown_out_level(), level);
        }
    }

    #[test]
    fn the_register_is_only_a_wish_until_it_is_programmed() {
        let mut options = open();
        assert_eq!(options.write(0x0FFE_AAEC), Ok(Request::Done));
        assert_eq!(options.read(false), 0x0FFE_AAEC);
        assert!(!options.protects(0, 0));
        options.reset();
        assert_eq!(options.read(false), 0x0FFF_AAED, "loaded again, and locked");
    }

    #[test]
    fn what_is_programmed_outlives_a_reset() {
        let mut options = open();
        assert_eq!(options.write(0x0FFC_AAEC | OPTSTRT), Ok(Request::Program(0x0FFC_AAEC)));
        assert_eq!(options.read(true), 0x0FFC_AAEE);
        assert!(!options.program(0x0FFC_AAEC));
        options.reset();
        assert_eq!(options.read(false), 0x0FFC_AAED);
        let protected: Vec<u8> = (0..12).filter(|sector| options.protects(0, *sector)).collect();
        assert_eq!(protected, [0, 1]);
    }

    /// Section 3.9.11: bits 16 to 27, a zero protects; programmed by OPTSTRT of OPTCR.
    #[test]
    fn the_second_bank_has_its_write_protection_in_optcr1() {
        let mut options = OptionBytes::default();
        assert_eq!(options.read_second(), 0x0FFF_0000);
        assert!(options.write_second(0).is_err(), "locked");
        let mut options = open();
        options.write_second(0xFFFD_FFFF).unwrap();
        assert_eq!(options.read_second(), 0x0FFD_0000);
        assert!(!options.protects(1, 1), "not programmed yet");
        options.program(0x0FFF_AAEC);
        options.reset();
        assert!((0..12).filter(|sector| options.protects(1, *sector)).eq([1]));
        assert!((0..12).all(|sector| !options.protects(0, sector)));
        options.preset_protection(1, 1, false);
        assert_eq!(options.read_second(), 0x0FFF_0000);
    }

    #[test]
    fn a_locked_register_does_not_change() {
        let mut options = OptionBytes::default();
        assert!(options.write(0x0FFE_AAEC | OPTSTRT).is_err());
        assert_eq!(options.read(false), 0x0FFF_AAED);
        let mut options = open();
        assert_eq!(options.write(0x0FFF_AAEC | OPTLOCK), Ok(Request::Done));
        assert!(options.write(0x0FFE_AAEC).is_err());
    }

    #[test]
    fn a_wrong_key_shuts_the_register_until_the_next_reset() {
        let mut options = open();
        assert!(options.write_key(0).is_err());
        assert!(options.write_key(0x0819_2A3B).is_err());
        assert!(options.write_key(0x4C5D_6E7F).is_err());
        assert_eq!(options.read(false), 0x0FFF_AAED);
        options.reset();
        assert_eq!(opened(options).read(false), 0x0FFF_AAEC);
    }

    /// Section 3.6.3, figure 5: 0 to 1 and back with a mass erase; 2 is the end.
    #[test]
    fn levels_of_read_out_protection() {
        let mut options = open();
        assert!(!options.program(0x0FFF_55EC));
        assert_eq!(options.level(), 1);
        assert!(!options.program(0x0FFE_55EC), "level 1 stays: nothing is erased");
        assert!(options.program(0x0FFF_AAEC), "back to level 0");
        assert!(!options.program(0x0FFF_CCEC));
        assert_eq!(options.level(), 2);
        assert!(options.write(0x0FFF_AAEC | OPTSTRT).is_err(), "never again");
    }

    #[test]
    fn torn_ones_load_as_erased() {
        let mut options = open();
        options.program(0x0FFC_AAEC);
        options.tear();
        options.reset();
        assert_eq!(options.read(false), 0x0FFF_FFED);
        assert_eq!(options.level(), 1);
    }

    /// Section 3.7.5: with SPRMOD a one of nWRP protects, and only the way from level 1 to level 0 takes a
    /// protection back; more sectors and other options may be set. OPTCR has BFB2 and SPRMOD on an STM32F42x
    /// alone (section 3.9.10 and the one before).
    #[test]
    fn a_protection_against_reading_goes_with_the_flash_alone() {
        const SECTOR_5: u32 = 0x8020_AAEC;
        let mut options = opened(OptionBytes::of(&STM32F429ZI));
        assert_eq!(options.write(SECTOR_5 | OPTSTRT), Ok(Request::Program(SECTOR_5)));
        options.program(SECTOR_5);
        assert!((0..12).filter(|sector| options.hides(0, *sector)).eq([5]));
        for (value, wanted) in [
            (SECTOR_5 & !SPRMOD, Request::Protected),
            (0x8000_AAEC, Request::Protected),
            (0x8001_AAEC, Request::Protected),
            (0x8021_AAEC, Request::Program(0x8021_AAEC)),
            (0x8020_AAE0, Request::Program(0x8020_AAE0)),
            (0x8020_AAFC, Request::Program(0x8020_AAFC)),
            (0x0FFF_55EC, Request::Protected),
        ] {
            assert_eq!(options.write(value | OPTSTRT), Ok(wanted), "{value:08X}h");
        }
        options.program(0x8020_55EC);
        assert_eq!(options.write(0x0FFF_AAEC | OPTSTRT), Ok(Request::Program(0x0FFF_AAEC)));
        assert!(options.program(0x0FFF_AAEC), "the array is erased");
        assert!((0..12).all(|sector| !options.hides(0, sector)));

        let mut options = opened(OptionBytes::of(&STM32F407VG));
        assert_eq!(options.write(0x8020_AAFC | OPTSTRT), Ok(Request::Program(0x0020_AAEC)));
        options.preset_all(0x8020_AAFC);
        assert!(!options.hides(0, 5) && !options.boots_from_system_memory());
    }

    /// The forum's report above: ones are SPRMOD and nWRP, too.
    #[test]
    fn torn_ones_of_an_stm32f429_hide_the_whole_flash() {
        let mut options = OptionBytes::of(&STM32F429ZI);
        options.tear();
        assert!((0..12).all(|sector| options.hides(0, sector) && options.hides(1, sector)));
        assert_eq!(options.level(), 1);
    }
}
