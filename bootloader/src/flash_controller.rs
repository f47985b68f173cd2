//! The flash controller (RM0090 section 3), at register level: it starts operations and polls them.
//! The resident part and the RAM image both use it, one at a time.
//!
//! The HAL's driver does not fit: it erases in units of 128 KiB, programs by bytes and does not
//! clear error flags.

use core::task::Poll;

use boot_core::flash::{is_write_protected, FlashFault, Operation};
use bsp::{pac, FLASH_WIDTH, LAYOUT};
use shared_abi::geometry::Region;

/// The two words that unlock the control register (section 3.6.1).
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// `PSIZE`: as wide as the board's supply allows (table 7).
const PSIZE: u8 = FLASH_WIDTH.trailing_zeros() as u8;
/// Whether a word takes more than one store.
const HAS_PARTS: bool = FLASH_WIDTH < 4;

/// The memory-mapped flash.
pub const FLASH: Region = LAYOUT.chip.flash;

/// Whether a word of the flash is at this address.
const fn is_word(address: u32) -> bool {
    address.wrapping_sub(FLASH.base) < FLASH.size && address.is_multiple_of(4)
}

/// The controller and the flash that it controls. The control register is locked unless an
/// operation runs.
pub struct FlashController {
    registers: pac::FLASH,
    /// What is left of the word that is being programmed.
    rest: [Rest; HAS_PARTS as usize],
}

/// The part of a word that is not programmed yet, at the lower end of `word`; none if the address is that of a
/// word.
#[derive(Default)]
struct Rest {
    address: u32,
    word: u32,
}

#[allow(dead_code, reason = "each of the two programs uses some of it")]
impl FlashController {
    /// Takes the controller.
    ///
    /// The caches of the flash must be off while it is programmed: they would return the old words
    /// (section 3.6.4). They are off after a reset. A bootloader that runs from RAM does not need
    /// them.
    ///
    /// # Safety
    /// Nothing else may use the controller until this value is dropped.
    pub unsafe fn steal() -> Self {
        Self {
            // SAFETY: the caller guarantees it.
            registers: unsafe { pac::FLASH::steal() },
            rest: [const { Rest { address: 0, word: 0 } }; HAS_PARTS as usize],
        }
    }

    /// Whether an operation runs.
    pub fn is_busy(&self) -> bool {
        self.registers.sr().read().bsy().bit_is_set()
    }

    /// Whether an operation runs, or other code has unlocked the control register.
    pub fn is_in_use(&self) -> bool {
        self.is_busy() || self.registers.cr().read().lock().bit_is_clear()
    }

    /// The option bytes, as the chip has them in `FLASH_OPTCR`.
    pub fn option_bytes(&self) -> u32 {
        self.registers.optcr().read().bits()
    }

    /// Whether the option bytes start the watchdog at each reset (WDG_SW, section 3.7.1).
    pub fn starts_watchdog(&self) -> bool {
        self.registers.optcr().read().wdg_sw().bit_is_clear()
    }

    /// Whether the option bytes protect a sector.
    pub fn is_protected(&self, sector: u8) -> bool {
        /// `FLASH_OPTCR1` of a chip with two banks (RM0090 section 3.9.11).
        const OPTCR1: *const u32 = 0x4002_3C18 as *const u32;
        let has_two_banks = LAYOUT.chip.second_bank.is_some();
        // SAFETY: a register of the controller of these chips, which a read does not change.
        let optcr1 = if has_two_banks { unsafe { OPTCR1.read_volatile() } } else { 0 };
        is_write_protected(sector, self.option_bytes(), optcr1)
    }

    /// Copies bytes; addresses outside the flash read as FFh.
    pub fn read(&self, address: u32, buffer: &mut [u8]) {
        for (byte, address) in buffer.iter_mut().zip(address..) {
            *byte = self.read_byte(address);
        }
    }

    /// The byte at an address, FFh outside the flash.
    pub fn read_byte(&self, address: u32) -> u8 {
        if address.wrapping_sub(FLASH.base) < FLASH.size {
            // SAFETY: the address is inside the memory-mapped flash, which is always readable. The
            // read is volatile, because the controller changes the memory without the compiler's
            // knowledge.
            unsafe { (address as *const u8).read_volatile() }
        } else {
            u8::MAX
        }
    }

    /// The word at a word-aligned address, FFFFFFFFh for other addresses.
    pub fn read_word(&self, address: u32) -> u32 {
        if is_word(address) {
            // SAFETY: as above, and aligned.
            unsafe { (address as *const u32).read_volatile() }
        } else {
            u32::MAX
        }
    }

    /// Starts an operation.
    ///
    /// # Errors
    /// If the operation is not valid for this flash.
    pub fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Erase(sector) => {
                self.unlock();
                self.registers.cr().write(|w| {
                    // SAFETY: the codes of the geometry are valid for SNB (sections 3.9.7 and
                    // 3.9.8).
                    unsafe { w.snb().bits(LAYOUT.chip.sector_code(sector.number)) };
                    w.lock().clear_bit().psize().set(PSIZE).ser().set_bit().strt().set_bit()
                });
            }
            Operation::Program { address, word } => {
                if !is_word(address) {
                    return Err(FlashFault::Failed);
                }
                self.unlock();
                self.registers.cr().write(|w| w.lock().clear_bit().psize().set(PSIZE).pg().set_bit());
                self.program(address, word);
            }
        }
        Ok(())
    }

    /// Starts to program a word, or the rest of one: as much as the board's supply allows at a time.
    fn program(&mut self, address: u32, word: u32) {
        // SAFETY: the address is in a word of the flash, and a multiple of the width; with PG set, the
        // store starts the operation.
        unsafe {
            match FLASH_WIDTH {
                4 => (address as *mut u32).write_volatile(word),
                2 => (address as *mut u16).write_volatile(word as u16),
                _ => (address as *mut u8).write_volatile(word as u8),
            }
        }
        if let Some(rest) = self.rest.first_mut() {
            // A width of 4 leaves no rest; `% 32` is for its arithmetic alone.
            *rest = Rest { address: address + FLASH_WIDTH, word: word >> (8 * FLASH_WIDTH % 32) };
        }
    }

    /// The result of the operation that was started last. Call it until it is ready, and not again.
    pub fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        let status = self.registers.sr().read();
        if status.bsy().bit_is_set() {
            return Poll::Pending;
        }
        let result = if status.wrperr().bit_is_set() {
            Err(FlashFault::Protected)
        } else if status.pgaerr().bit_is_set() || status.pgperr().bit_is_set() || status.pgserr().bit_is_set()
        {
            Err(FlashFault::Failed)
        } else {
            Ok(())
        };
        if let Some(Rest { address, word }) = self.rest.first_mut().map(core::mem::take) {
            if result.is_ok() && !address.is_multiple_of(4) {
                self.program(address, word);
                return Poll::Pending;
            }
        }
        self.clear_flags();
        self.registers.cr().write(|w| w.lock().set_bit());
        Poll::Ready(result)
    }

    /// Clears all flags.
    pub fn clear_flags(&self) {
        let flags = self.registers.sr().read().bits();
        // SAFETY: writing the flags of SR back clears them.
        self.registers.sr().write(|w| unsafe { w.bits(flags) });
    }

    /// Unlocks the control register for one operation. (A `write` starts from the register's reset
    /// value, in which LOCK is set: each write must clear that bit.)
    fn unlock(&mut self) {
        // Flags of an earlier operation would count as the result of this one.
        self.clear_flags();
        if self.registers.cr().read().lock().bit_is_set() {
            for key in KEYS {
                // SAFETY: any word may be written to KEYR; these two unlock the control register.
                self.registers.keyr().write(|w| unsafe { w.bits(key) });
            }
        }
    }
}
