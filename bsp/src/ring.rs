//! A ring of bytes between an interrupt and the rest of the program: one side puts, the other takes, and neither waits.

use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

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

#[cfg(test)]
mod tests {
    use super::Ring;

    #[test]
    fn bytes_come_out_as_they_went_in_and_one_too_many_is_refused() {
        let ring: Ring<4> = Ring::new();
        for round in 0..10 {
            assert!(ring.is_empty() && ring.take().is_none());
            assert_eq!([1, 2, 3, 4].map(|byte| ring.put(byte + round)), [true, true, true, false]);
            assert_eq!((ring.len(), ring.room()), (3, 0));
            assert_eq!(ring.take(), Some(1 + round));
            assert!(ring.put(9) && !ring.put(9));
            assert_eq!([(); 4].map(|()| ring.take()), [Some(2 + round), Some(3 + round), Some(9), None]);
        }
    }
}
