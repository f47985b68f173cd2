//! The caches of the flash interface (RM0090 section 3.5): off while the flash is programmed, since
//! an application may have switched them on, and on while the boot stage works.

use bsp::pac;

/// Keeps them as they have to be for a while; when dropped, makes them forget what they hold and
/// leaves them as they were.
pub struct Caches {
    registers: pac::FLASH,
    before: u32,
}

/// `ICEN`, `DCEN` of the access control register (section 3.8.1).
const CACHES: u32 = 0b11 << 9;
/// `PRFTEN`. The boot stage does without: the first revision of the chip cannot prefetch.
const PREFETCH: u32 = 1 << 8;
/// `ICRST`, `DCRST`: only while the caches are off.
const RESETS: u32 = 0b11 << 11;

impl Caches {
    /// Off, and the prefetch with them.
    ///
    /// # Safety
    /// Nobody else may change the access control register until this is dropped.
    pub unsafe fn off() -> Self {
        // SAFETY: the caller vouches for it.
        unsafe { Self::set(0) }
    }

    /// On: code in flash is some five times as fast at the full clock.
    ///
    /// # Safety
    /// As for [`off`](Self::off); and they were off since the flash was programmed last.
    pub unsafe fn on() -> Self {
        // SAFETY: the caller vouches for it.
        unsafe { Self::set(CACHES) }
    }

    unsafe fn set(enabled: u32) -> Self {
        // SAFETY: the caller vouches for it.
        let registers = unsafe { pac::FLASH::steal() };
        let before = registers.acr().read().bits();
        let this = Self { registers, before };
        this.write(this.disabled() | enabled);
        this
    }

    /// The register as it was, with everything off.
    fn disabled(&self) -> u32 {
        self.before & !(CACHES | PREFETCH)
    }

    fn write(&self, bits: u32) {
        // SAFETY: the wait states stay, and the rest may be switched at any time, the resets while
        // the caches are off.
        self.registers.acr().write(|w| unsafe { w.bits(bits) });
    }
}

impl Drop for Caches {
    #[inline(never)]
    fn drop(&mut self) {
        let off = self.disabled();
        self.write(off);
        self.write(off | RESETS);
        self.write(off);
        self.write(self.before);
    }
}
