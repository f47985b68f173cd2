//! The flash for the resident part, with sectors, CRC unit (RM0090 section 4) and blank check. The
//! RAM image uses these through [`shared_abi::services`].

use core::task::Poll;

use boot_core::crc;
use boot_core::flash::{Flash, FlashFault, Operation};
use bsp::functions::{self, HAS_EACH_10_MS};
use bsp::{pac, LAYOUT};
use shared_abi::geometry::{Region, Sector};

use crate::flash_controller::{FlashController, FLASH};

/// Who has the CRC unit.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum CrcUnit {
    /// The bootloader; its clock is on.
    Own,
    /// An application, whose interrupts may use it: it is taken for a moment, if it is free.
    Shared,
    /// Other code.
    Taken,
}

/// Whether an application's CRC is computed by the unit. The compact map has no room for that, and computes it in
/// software.
const SHARES_CRC_UNIT: bool = LAYOUT.home.is_some();
/// The bytes whose CRC is computed while the interrupts of an application wait: some 50 us at 16 MHz.
const SHARED_STEP: u32 = 512;

/// The bytes whose CRC the unit computes between two looks at the time, for a board that wants to be called each
/// 10 ms: a millisecond.
const PART: u32 = 64 * 1024;

/// The controller, and the CRC unit if no other code uses it.
pub struct ResidentFlash {
    controller: FlashController,
    crc_unit: CrcUnit,
    /// Whether the boot stage runs, and the board's [`each_10_ms`](functions::Functions::each_10_ms) is called.
    in_stage: [bool; HAS_EACH_10_MS as usize],
}

impl ResidentFlash {
    /// Takes the controller, and the CRC unit if it is [`CrcUnit::Own`].
    ///
    /// # Safety
    /// Nothing else may use what is taken until this value is dropped.
    pub unsafe fn steal(crc_unit: CrcUnit) -> Self {
        // SAFETY: the caller guarantees it.
        Self { controller: unsafe { FlashController::steal() }, crc_unit, in_stage: [false; _] }
    }

    /// The same for the boot stage, which calls the board's functions.
    ///
    /// # Safety
    /// As for [`functions::poll`].
    pub unsafe fn in_stage(self) -> Self {
        Self { in_stage: [true; _], ..self }
    }

    /// Calls the board's function in the boot stage, if it is time.
    fn poll_board(&self) {
        if let Some(true) = self.in_stage.first() {
            // SAFETY: the caller of `in_stage` guarantees it.
            unsafe { functions::poll() };
        }
    }

    /// Switches the clock of the CRC unit on.
    pub fn switch_crc_unit_on(rcc: &pac::RCC) {
        rcc.ahb1enr().modify(|_, w| w.crcen().enabled());
    }

    /// See [`FlashController::starts_watchdog`].
    pub fn starts_watchdog(&self) -> bool {
        self.controller.starts_watchdog()
    }

    /// Leaves both in their reset state.
    pub fn release(self, rcc: &pac::RCC) {
        if self.crc_unit == CrcUnit::Own {
            // SAFETY: `steal` has taken the unit.
            unsafe { pac::CRC::steal() }.cr().write(|w| w.reset().set_bit());
            rcc.ahb1enr().modify(|_, w| w.crcen().disabled());
        }
        self.controller.clear_flags();
    }

    /// The CRC unit computes whole words, software the rest. The unit has the right polynomial, but
    /// it takes words with the most significant bit first and always starts from its initial value.
    /// One additional word first brings it to the state of the previous CRC.
    fn crc32_of(&self, mut crc: u32, region: Region) -> u32 {
        let (mut address, end) = (region.base, region.end());
        let is_fit = address.is_multiple_of(4) && FLASH.contains(address, region.size);
        if is_fit && self.crc_unit == CrcUnit::Own {
            // SAFETY: `steal` has taken the unit.
            let unit = unsafe { pac::CRC::steal() };
            unit.cr().write(|w| w.reset().set_bit());
            let data = unit.dr().as_ptr();
            // SAFETY: every word may be written to DR. The region was checked to be aligned and
            // inside the memory-mapped flash, which is always readable.
            unsafe {
                if crc != 0 {
                    data.write_volatile(u32::MAX ^ word_before((!crc).reverse_bits()));
                }
                // The loop takes four words at a time and is in assembly: it takes most of the time
                // from reset to a large program, and the compiler would move its body into a
                // function.
                while end - address >= 16 {
                    core::arch::asm!(
                        "ldmia {from}!, {{r2, r3, r4, r5}}",
                        "rbit r2, r2",
                        "str r2, [{data}]",
                        "rbit r3, r3",
                        "str r3, [{data}]",
                        "rbit r4, r4",
                        "str r4, [{data}]",
                        "rbit r5, r5",
                        "str r5, [{data}]",
                        from = inout(reg) address,
                        data = in(reg) data,
                        out("r2") _,
                        out("r3") _,
                        out("r4") _,
                        out("r5") _,
                        options(nostack, preserves_flags),
                    );
                }
                while end - address >= 4 {
                    data.write_volatile((address as *const u32).read_volatile().reverse_bits());
                    address += 4;
                }
                crc = !data.read_volatile().reverse_bits();
            }
        }
        (address..end).fold(crc, |crc, address| crc::resume(crc, &[self.controller.read_byte(address)]))
    }

    /// The CRC of words with the unit of an application. Its interrupts wait for each part: one that uses the unit,
    /// or changes the register of its clock, finds and leaves both as they are.
    fn crc32_by_parts(crc: u32, region: Region) -> u32 {
        (region.base..region.end()).step_by(SHARED_STEP as usize).fold(crc, |crc, at| {
            let part = Region::new(at, SHARED_STEP.min(region.end() - at));
            let by_unit = cortex_m::interrupt::free(|_| {
                // SAFETY: nothing interrupts this code, which reads the flash and takes a unit that has no clock.
                let (rcc, flash) = unsafe { (pac::RCC::steal(), Self::steal(CrcUnit::Own)) };
                rcc.ahb1enr().read().crcen().is_disabled().then(|| {
                    Self::switch_crc_unit_on(&rcc);
                    let crc = flash.crc32_of(crc, part);
                    flash.release(&rcc);
                    crc
                })
            });
            // SAFETY: it only reads the flash.
            by_unit.unwrap_or_else(|| unsafe { Self::steal(CrcUnit::Taken) }.crc32_of(crc, part))
        })
    }
}

impl Flash for ResidentFlash {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.poll_board();
        self.controller.read(address, buffer);
    }

    fn read_word(&self, address: u32) -> u32 {
        self.controller.read_word(address)
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        LAYOUT.chip.sector_at(address)
    }

    fn is_blank(&self, region: Region) -> bool {
        let (mut address, end) = (region.base, region.end());
        if address.is_multiple_of(4) && FLASH.contains(address, region.size) {
            // It compares words, in a short loop.
            while end - address >= 4 {
                // SAFETY: inside the memory-mapped flash, which is always readable, and aligned.
                if unsafe { (address as *const u32).read_volatile() } != u32::MAX {
                    return false;
                }
                address += 4;
            }
        }
        (address..end).all(|address| self.controller.read_byte(address) == u8::MAX)
    }

    fn crc32(&self, crc: u32, region: Region) -> u32 {
        let is_fit = region.base.is_multiple_of(4) && FLASH.contains(region.base, region.size);
        if SHARES_CRC_UNIT && is_fit && self.crc_unit == CrcUnit::Shared {
            return Self::crc32_by_parts(crc, region);
        }
        if !HAS_EACH_10_MS {
            return self.crc32_of(crc, region);
        }
        (region.base..region.end()).step_by(PART as usize).fold(crc, |crc, at| {
            self.poll_board();
            self.crc32_of(crc, Region::new(at, PART.min(region.end() - at)))
        })
    }

    /// The resident part erases nothing: boot stage and application must not wait for it. What needs an erase
    /// fails, and the RAM image does it.
    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Erase(_) => Err(FlashFault::Failed),
            Operation::Program { .. } => self.controller.start(operation),
        }
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        self.controller.poll()
    }
}

/// The word that takes the CRC unit from 0 to this state, found by 32 steps backwards.
fn word_before(mut state: u32) -> u32 {
    /// The polynomial of the unit.
    const POLYNOMIAL: u32 = 0x04C1_1DB7;
    for _ in 0..32 {
        state = if state & 1 != 0 { (state ^ POLYNOMIAL) >> 1 | 1 << 31 } else { state >> 1 };
    }
    state
}
