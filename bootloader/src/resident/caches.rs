//! The caches of the flash interface (RM0090 section 3.5). They are off while the flash is
//! programmed, because an application may have enabled them, and on while the boot stage works.

use bsp::pac;

/// Keeps the caches on or off. When it is dropped, it empties the caches; after [`off`](Self::off) it also
/// restores their state.
pub struct Caches {
    registers: pac::FLASH,
    before: u32,
}

/// `ICEN`, `DCEN` of the access control register (section 3.9.1).
const CACHES: u32 = 0b11 << 9;
/// `PRFTEN`. The boot stage does not use it: the first revision of the chip cannot prefetch.
const PREFETCH: u32 = 1 << 8;
/// `ICRST`, `DCRST`: they may be set only while the caches are off.
const RESETS: u32 = 0b11 << 11;

impl Caches {
    /// Switches the caches and the prefetch off, and empties the caches.
    ///
    /// # Safety
    /// Nothing else may change the access control register until this value is dropped.
    pub unsafe fn off() -> Self {
        // SAFETY: the caller guarantees it.
        unsafe { Self::set(0) }
    }

    /// Switches the caches on: code in flash is some five times as fast at the full clock. When this
    /// value is dropped, they are off: an application that has jumped here may have left them on, and
    /// the RAM image programs without them.
    ///
    /// # Safety
    /// As for [`off`](Self::off).
    pub unsafe fn on() -> Self {
        // SAFETY: the caller guarantees it.
        unsafe { Self::set(CACHES) }
    }

    unsafe fn set(enabled: u32) -> Self {
        // SAFETY: the caller guarantees it.
        let registers = unsafe { pac::FLASH::steal() };
        let before = registers.acr().read().bits();
        let mut this = Self { registers, before };
        this.empty();
        if enabled != 0 {
            this.before = this.disabled();
            this.write(this.before | enabled);
        }
        this
    }

    /// Empties the caches, which are off then.
    fn empty(&self) {
        let off = self.disabled();
        self.write(off);
        self.write(off | RESETS);
        self.write(off);
    }

    /// The register's original value, with caches, prefetch and resets off.
    fn disabled(&self) -> u32 {
        self.before & !(CACHES | PREFETCH | RESETS)
    }

    fn write(&self, bits: u32) {
        // SAFETY: the wait states stay. The other bits may change at any time; the resets are set
        // only while the caches are off.
        self.registers.acr().write(|w| unsafe { w.bits(bits) });
    }
}

impl Drop for Caches {
    fn drop(&mut self) {
        self.empty();
        // A cache that stayed in reset would be empty for ever.
        self.write(self.before & !RESETS);
    }
}
