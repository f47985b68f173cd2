//! A ring of bytes between an interrupt and the rest of the program: one side puts bytes, the other
//! takes them, and neither waits.

use core::sync::atomic::{AtomicBool, AtomicU8, AtomicUsize, Ordering};

/// A ring for `N` - 1 bytes: a full ring would look like an empty one.
pub struct Ring<const N: usize> {
    bytes: [AtomicU8; N],
    /// Index of the next byte to put; only the putting side changes it.
    put: AtomicUsize,
    /// Index of the next byte to take; only the taking side changes it.
    taken: AtomicUsize,
}

impl<const N: usize> Ring<N> {
    /// An empty ring.
    #[must_use]
    pub const fn new() -> Self {
        Self { bytes: [const { AtomicU8::new(0) }; N], put: AtomicUsize::new(0), taken: AtomicUsize::new(0) }
    }

    /// Whether the ring has no bytes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of bytes in the ring.
    pub fn len(&self) -> usize {
        (self.put.load(Ordering::Acquire) + N - self.taken.load(Ordering::Acquire)) % N
    }

    /// Number of bytes that fit into the ring.
    pub fn room(&self) -> usize {
        N - 1 - self.len()
    }

    /// Puts a byte; returns whether there was room for it.
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

/// The mark that stands for lost bytes.
pub const LOST: u8 = 0;

/// The bytes of a line that may lose some, with a mark at each place where bytes are lost.
pub struct Inbox<const N: usize> {
    ring: Ring<N>,
    /// Bytes are lost after the last one of the ring, and the mark is not there yet.
    gap: AtomicBool,
    lost: AtomicBool,
}

impl<const N: usize> Inbox<N> {
    /// An empty inbox.
    #[must_use]
    pub const fn new() -> Self {
        Self { ring: Ring::new(), gap: AtomicBool::new(false), lost: AtomicBool::new(false) }
    }

    /// Puts a received byte, or the mark for an unreadable one; after it, other bytes may be lost.
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

    /// Whether the reader should take bytes now: more than half of the room is used.
    pub fn is_pressing(&self) -> bool {
        self.ring.len() > self.ring.room()
    }

    /// Whether bytes were lost since the previous call.
    pub fn take_overruns(&self) -> bool {
        self.lost.swap(false, Ordering::Relaxed)
    }
}

impl<const N: usize> Default for Inbox<N> {
    fn default() -> Self {
        Self::new()
    }
}
