//! The flash controller (RM0090 section 3) and the CRC unit (section 4), at the level of their
//! registers.
//!
//! The HAL's driver does not fit: it erases in units of 128 KiB, programs by bytes and leaves error
//! flags standing.

use core::task::Poll;

use boot_core::crc;
use boot_core::flash::{crc32_by_software, Flash, FlashFault};
use bsp::{pac, LAYOUT};
use shared_abi::geometry::{Region, Sector};

/// Section 3.6.1: the two words that open the control register.
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
/// `PSIZE` for words: the supply is 2.7 V or more (table 10).
const WORDS: u8 = 0b10;

/// The controller and the flash that it guards. The control register is locked whenever no
/// operation runs.
pub struct FlashController {
    registers: pac::FLASH,
    /// The CRC unit, where it is not somebody else's.
    crc: Option<pac::CRC>,
    running: bool,
}

/// What it guards.
const FLASH: Region = LAYOUT.chip.flash;

impl FlashController {
    /// Takes the controller, and the CRC unit if `rcc` is there to switch it on.
    ///
    /// The caches of the flash have to be off: they would show words as they were before they were
    /// programmed (section 3.5.4). They are so after a reset, and a bootloader that runs from RAM
    /// gains nothing by them.
    ///
    /// # Safety
    /// Nobody else may use the two until this is dropped.
    pub unsafe fn steal(rcc: Option<&pac::RCC>) -> Self {
        let crc = rcc.map(|rcc| {
            rcc.ahb1enr().modify(|_, w| w.crcen().enabled());
            // SAFETY: the caller vouches for it.
            unsafe { pac::CRC::steal() }
        });
        // SAFETY: the caller vouches for it.
        Self { registers: unsafe { pac::FLASH::steal() }, crc, running: false }
    }

    /// Leaves both as after a reset.
    pub fn release(self, rcc: &pac::RCC) {
        if let Some(crc) = &self.crc {
            crc.cr().write(|w| w.reset().set_bit());
            rcc.ahb1enr().modify(|_, w| w.crcen().disabled());
        }
        self.clear_flags();
    }

    /// Whether somebody is at work on the flash, or has opened the control register for it. To be
    /// asked before anything is taken: who is told to wait has to find all as it was.
    #[cfg(feature = "resident")]
    pub fn is_in_use() -> bool {
        // SAFETY: reading these two registers has no effect, whoever owns them.
        let registers = unsafe { pac::FLASH::steal() };
        registers.sr().read().bsy().bit_is_set() || registers.cr().read().lock().bit_is_clear()
    }

    /// Opens the control register for one operation. (A `write` starts from the register's reset
    /// value, in which LOCK is set: whoever writes it has to clear that.)
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

    fn clear_flags(&self) {
        let flags = self.registers.sr().read().bits();
        // SAFETY: the flags of SR are cleared by writing them back.
        self.registers.sr().write(|w| unsafe { w.bits(flags) });
    }

    fn lock(&mut self) {
        self.registers.cr().write(|w| w.lock().set_bit());
    }
}

impl Flash for FlashController {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        for (byte, address) in buffer.iter_mut().zip(address..) {
            *byte = if FLASH.contains(address, 1) {
                // SAFETY: the address is inside the memory-mapped flash, which is always readable;
                // volatile, because the controller changes it behind the compiler's back.
                unsafe { (address as *const u8).read_volatile() }
            } else {
                u8::MAX
            };
        }
    }

    fn read_word(&self, address: u32) -> u32 {
        if FLASH.contains(address, 4) && address.is_multiple_of(4) {
            // SAFETY: as above, and aligned.
            unsafe { (address as *const u32).read_volatile() }
        } else {
            u32::MAX
        }
    }

    /// By the unit. It has the polynomial, but takes words with the most significant bit first, and
    /// starts anew: what went before comes back as one word that leaves it in the same state.
    fn crc32(&self, crc: u32, region: Region) -> u32 {
        let Some(unit) = &self.crc else { return crc32_by_software(self, crc, region) };
        if !region.base.is_multiple_of(4) || !FLASH.contains(region.base, region.size) {
            return crc32_by_software(self, crc, region);
        }
        let words = region.size / 4;
        let (control, unit) = (unit.cr(), unit.dr());
        // SAFETY: every word may be written to DR.
        let feed = |word: u32| unit.write(|w| unsafe { w.bits(word) });
        control.write(|w| w.reset().set_bit());
        if crc != 0 {
            feed(u32::MAX ^ word_before((!crc).reverse_bits()));
        }
        // SAFETY: the region was checked to be inside the memory-mapped flash, which is always
        // readable.
        let feed_from =
            |address: u32| feed(unsafe { (address as *const u32).read_volatile() }.reverse_bits());
        let (mut address, end) = (region.base, region.base + words * 4);
        // Four at a time: on the way from reset to a large program this loop is most of the time.
        while end - address >= 16 {
            feed_from(address);
            feed_from(address + 4);
            feed_from(address + 8);
            feed_from(address + 12);
            address += 16;
        }
        while address < end {
            feed_from(address);
            address += 4;
        }
        let crc = !unit.read().bits().reverse_bits();
        let mut tail = [0; 3];
        let tail = &mut tail[..region.size as usize % 4];
        self.read(region.base + words * 4, tail);
        crc::resume(crc, tail)
    }

    fn start_erase(&mut self, sector: Sector) -> Result<(), FlashFault> {
        self.unlock();
        self.registers.cr().write(|w| {
            // SAFETY: the geometry's codes are those that SNB takes (sections 3.9.7 and 3.9.8).
            unsafe { w.snb().bits(LAYOUT.chip.sector_code(sector.number)) };
            w.lock().clear_bit().psize().set(WORDS).ser().set_bit().strt().set_bit()
        });
        self.running = true;
        Ok(())
    }

    fn start_program(&mut self, address: u32, word: u32) -> Result<(), FlashFault> {
        if !FLASH.contains(address, 4) || !address.is_multiple_of(4) {
            return Err(FlashFault::Failed);
        }
        self.unlock();
        self.registers.cr().write(|w| w.lock().clear_bit().psize().set(WORDS).pg().set_bit());
        // SAFETY: the address was checked to be a word of the flash; with PG set, the store starts
        // the operation.
        unsafe { (address as *mut u32).write_volatile(word) };
        self.running = true;
        Ok(())
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        if !self.running {
            return Poll::Ready(Ok(()));
        }
        let status = self.registers.sr().read();
        if status.bsy().bit_is_set() {
            return Poll::Pending;
        }
        self.running = false;
        self.clear_flags();
        self.lock();
        Poll::Ready(if status.wrperr().bit_is_set() {
            Err(FlashFault::Protected)
        } else if status.pgaerr().bit_is_set() || status.pgperr().bit_is_set() || status.pgserr().bit_is_set()
        {
            Err(FlashFault::Failed)
        } else {
            Ok(())
        })
    }
}

/// The word that takes the CRC unit from 0 to this state: its 32 steps backwards.
fn word_before(mut state: u32) -> u32 {
    /// The polynomial of the unit.
    const POLYNOMIAL: u32 = 0x04C1_1DB7;
    for _ in 0..32 {
        state = if state & 1 != 0 { (state ^ POLYNOMIAL) >> 1 | 1 << 31 } else { state >> 1 };
    }
    state
}
