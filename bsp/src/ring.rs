//! A ring of bytes between an interrupt and the rest of the program: one side puts, the other
//! takes, and neither waits.

use core::sync::atomic::{AtomicBool, AtomicU8, AtomicUsize, Ordering};

/// Room for `N` - 1 bytes: a full ring would look like an empty one.
pub struct Ring<const N: usize> {
    bytes: [AtomicU8; N],
    /// Where the next byte goes; of the side that puts.
    put: AtomicUsize,
    /// Where the next one is; of the side that takes.
    taken: AtomicUsize,
}

impl<const N: usize> Ring<N> {
    /// An empty ring.
    #[must_use]
    pub const fn new() -> Self {
        Self { bytes: [const { AtomicU8::new(0) }; N], put: AtomicUsize::new(0), taken: AtomicUsize::new(0) }
    }

    /// Whether there is nothing to take.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// How many bytes there are to take.
    pub fn len(&self) -> usize {
        (self.put.load(Ordering::Acquire) + N - self.taken.load(Ordering::Acquire)) % N
    }

    /// How many bytes there is room for.
    pub fn room(&self) -> usize {
        N - 1 - self.len()
    }

    /// Puts a byte; whether there was room for it.
    pub fn put(&self, byte: u8) -> bool {
        let at = self.put.load(Ordering::Relaxed) % N;
        let fits = self.room() > 0;
        if fits {
            self.bytes[at].store(byte, Ordering::Relaxed);
            self.put.store((at + 1) % N, Ordering::Release);
        }
        fits
    }

    /// Takes a byte, if there is one.
    pub fn take(&self) -> Option<u8> {
        let at = self.taken.load(Ordering::Relaxed) % N;
        let byte = (!self.is_empty()).then(|| self.bytes[at].load(Ordering::Relaxed))?;
        self.taken.store((at + 1) % N, Ordering::Release);
        Some(byte)
    }
}

impl<const N: usize> Default for Ring<N> {
    fn default() -> Self {
        Self::new()
    }
}

/// A byte in the place of those that are missing.
pub const LOST: u8 = 0;

/// What comes from a line that loses bytes now and then, with a mark wherever some are missing.
pub struct Inbox<const N: usize> {
    ring: Ring<N>,
    /// Bytes are missing behind the last one of the ring, and the mark is not there yet.
    gap: AtomicBool,
    lost: AtomicBool,
}

impl<const N: usize> Inbox<N> {
    /// An empty one.
    #[must_use]
    pub const fn new() -> Self {
        Self { ring: Ring::new(), gap: AtomicBool::new(false), lost: AtomicBool::new(false) }
    }

    /// A byte has come, or one that cannot be read; behind it, others may be missing.
    pub fn come(&self, byte: Option<u8>, others_missing: bool) {
        if self.gap.load(Ordering::Relaxed) && self.ring.room() >= 2 {
            self.ring.put(LOST);
            self.gap.store(false, Ordering::Relaxed);
        }
        let fits = !self.gap.load(Ordering::Relaxed) && self.ring.put(byte.unwrap_or(LOST));
        let gap = !fits || others_missing;
        self.gap.store(gap, Ordering::Relaxed);
        if gap || byte.is_none() {
            self.lost.store(true, Ordering::Relaxed);
        }
    }

    /// Takes a byte or a mark, if there is one.
    pub fn take(&self) -> Option<u8> {
        self.ring.take()
    }

    /// Whether it is time to take: half of the room is used.
    pub fn is_pressing(&self) -> bool {
        self.ring.len() > self.ring.room()
    }

    /// Whether something was lost since the question before.
    pub fn take_overruns(&self) -> bool {
        self.lost.swap(false, Ordering::Relaxed)
    }
}

impl<const N: usize> Default for Inbox<N> {
    fn default() -> Self {
        Self::new()
    }
}
