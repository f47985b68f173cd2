//! The caches of the flash interface (RM0090 section 3.5), which an application may have switched
//! on.

use bsp::pac;

/// Keeps them off, and the prefetch with them; when dropped, makes them forget what they hold and
/// leaves them as they were.
pub struct CachesOff {
    registers: pac::FLASH,
    before: u32,
}

/// `PRFTEN`, `ICEN`, `DCEN` of the access control register (section 3.8.1).
const ENABLES: u32 = 0b111 << 8;
/// `ICRST`, `DCRST`: only while the caches are off.
const RESETS: u32 = 0b11 << 11;

impl CachesOff {
    /// # Safety
    /// Nobody else may change the access control register until this is dropped.
    pub unsafe fn new() -> Self {
        // SAFETY: the caller vouches for it.
        let registers = unsafe { pac::FLASH::steal() };
        let before = registers.acr().read().bits();
        let this = Self { registers, before };
        this.write(before & !ENABLES);
        this
    }

    fn write(&self, bits: u32) {
        // SAFETY: the wait states stay, and the rest may be switched at any time, the resets while
        // the caches are off.
        self.registers.acr().write(|w| unsafe { w.bits(bits) });
    }
}

impl Drop for CachesOff {
    fn drop(&mut self) {
        let off = self.before & !ENABLES;
        self.write(off | RESETS);
        self.write(off);
        self.write(self.before);
    }
}
