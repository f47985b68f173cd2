//! The flash controller (RM0090 section 3), at the level of its registers: starts operations and
//! polls them. Resident part and RAM part both use it, in turn.
//!
//! The HAL's driver does not fit: it erases in units of 128 KiB, programs by bytes and leaves error
//! flags standing.

use core::task::Poll;

use boot_core::flash::{FlashFault, Operation};
use bsp::{pac, LAYOUT};
use shared_abi::geometry::Region;

/// Section 3.6.1: the two words that open the control register.
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// `PSIZE` for words: the supply is 2.7 V or more (table 10).
const WORDS: u8 = 0b10;

/// The memory-mapped flash.
pub const FLASH: Region = LAYOUT.chip.flash;

/// The controller and the flash that it guards. The control register is locked whenever no
/// operation runs.
pub struct FlashController {
    registers: pac::FLASH,
}

#[allow(dead_code, reason = "each of the two programs uses some of it")]
impl FlashController {
    /// Takes the controller.
    ///
    /// The caches of the flash have to be off while it is programmed: they would show words as they
    /// were before (section 3.5.4). They are so after a reset, and a bootloader that runs from RAM
    /// gains nothing by them.
    ///
    /// # Safety
    /// Nobody else may use it until this is dropped.
    pub unsafe fn steal() -> Self {
        // SAFETY: the caller vouches for it.
        Self { registers: unsafe { pac::FLASH::steal() } }
    }

    /// Whether an operation runs.
    pub fn is_busy(&self) -> bool {
        self.registers.sr().read().bsy().bit_is_set()
    }

    /// Whether somebody is at work on the flash, or has opened the control register for it.
    pub fn is_in_use(&self) -> bool {
        self.is_busy() || self.registers.cr().read().lock().bit_is_clear()
    }

    /// Copies bytes; addresses outside the flash read FFh.
    pub fn read(&self, address: u32, buffer: &mut [u8]) {
        for (byte, address) in buffer.iter_mut().zip(address..) {
            *byte = self.read_byte(address);
        }
    }

    /// The byte at an address, FFh outside the flash.
    pub fn read_byte(&self, address: u32) -> u8 {
        if FLASH.contains(address, 1) {
            // SAFETY: the address is inside the memory-mapped flash, which is always readable;
            // volatile, because the controller changes it behind the compiler's back.
            unsafe { (address as *const u8).read_volatile() }
        } else {
            u8::MAX
        }
    }

    /// The word at a word-aligned address, FFFFFFFFh elsewhere.
    #[inline(never)]
    pub fn read_word(&self, address: u32) -> u32 {
        if FLASH.contains(address, 4) && address.is_multiple_of(4) {
            // SAFETY: as above, and aligned.
            unsafe { (address as *const u32).read_volatile() }
        } else {
            u32::MAX
        }
    }

    /// Starts an operation.
    ///
    /// # Errors
    /// If it is none of this flash.
    pub fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Erase(sector) => {
                self.unlock();
                self.registers.cr().write(|w| {
                    // SAFETY: the geometry's codes are those that SNB takes (sections 3.9.7 and
                    // 3.9.8).
                    unsafe { w.snb().bits(LAYOUT.chip.sector_code(sector.number)) };
                    w.lock().clear_bit().psize().set(WORDS).ser().set_bit().strt().set_bit()
                });
            }
            Operation::Program { address, word } => {
                if !FLASH.contains(address, 4) || !address.is_multiple_of(4) {
                    return Err(FlashFault::Failed);
                }
                self.unlock();
                self.registers.cr().write(|w| w.lock().clear_bit().psize().set(WORDS).pg().set_bit());
                // SAFETY: the address was checked to be a word of the flash; with PG set, the store
                // starts the operation.
                unsafe { (address as *mut u32).write_volatile(word) };
            }
        }
        Ok(())
    }

    /// The outcome of the operation that was started last; to be asked for once.
    pub fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        let status = self.registers.sr().read();
        if status.bsy().bit_is_set() {
            return Poll::Pending;
        }
        self.clear_flags();
        self.registers.cr().write(|w| w.lock().set_bit());
        Poll::Ready(if status.wrperr().bit_is_set() {
            Err(FlashFault::Protected)
        } else if status.pgaerr().bit_is_set() || status.pgperr().bit_is_set() || status.pgserr().bit_is_set()
        {
            Err(FlashFault::Failed)
        } else {
            Ok(())
        })
    }

    /// Leaves no flag standing.
    pub fn clear_flags(&self) {
        let flags = self.registers.sr().read().bits();
        // SAFETY: the flags of SR are cleared by writing them back.
        self.registers.sr().write(|w| unsafe { w.bits(flags) });
    }

    /// Opens the control register for one operation. (A `write` starts from the register's reset
    /// value, in which LOCK is set: each write has to clear that.)
    fn unlock(&mut self) {
        // What an earlier operation left behind would be taken for the outcome of this one.
        self.clear_flags();
        if self.registers.cr().read().lock().bit_is_set() {
            for key in KEYS {
                // SAFETY: any word may be written to KEYR; these two unlock the control register.
                self.registers.keyr().write(|w| unsafe { w.bits(key) });
            }
        }
    }
}
