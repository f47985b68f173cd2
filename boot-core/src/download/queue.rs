//! The blocks that were received and are not in flash yet: a ring of bytes, so that the flash may
//! lag behind the bus.
//!
//! A block is *open* while it arrives. It is judged as a whole, and then either joins the queue or
//! is forgotten. Offsets count from the front of the queue or of the open block.

/// A ring of bytes; its front is the oldest block.
pub(super) struct Queue<'b> {
    buffer: &'b mut [u8],
    front: usize,
    queued: usize,
    open: usize,
}

impl<'b> Queue<'b> {
    pub(super) fn new(buffer: &'b mut [u8]) -> Self {
        Self { buffer, front: 0, queued: 0, open: 0 }
    }

    /// The bytes behind it, for the next one.
    pub(super) fn into_buffer(self) -> &'b mut [u8] {
        self.buffer
    }

    pub(super) fn capacity(&self) -> usize {
        self.buffer.len()
    }

    pub(super) fn free(&self) -> usize {
        self.buffer.len() - self.queued - self.open
    }

    pub(super) fn is_empty(&self) -> bool {
        self.queued == 0
    }

    /// Bytes of the open block.
    pub(super) fn open(&self) -> usize {
        self.open
    }

    /// Adds to the open block what there is room for; whether that was all.
    pub(super) fn push(&mut self, data: &[u8]) -> bool {
        if data.len() > self.free() {
            return false;
        }
        for byte in data {
            let at = self.place(self.queued + self.open);
            self.buffer[at] = *byte;
            self.open += 1;
        }
        true
    }

    /// Puts other bytes in place of some of the open block.
    #[cfg(feature = "streams")]
    pub(super) fn patch(&mut self, offset: usize, bytes: &[u8]) {
        for (i, byte) in bytes.iter().enumerate() {
            let at = self.place(self.queued + offset + i);
            self.buffer[at] = *byte;
        }
    }

    /// The open block is good: it joins the queue.
    pub(super) fn commit(&mut self) {
        self.queued += self.open;
        self.open = 0;
    }

    /// The open block is not.
    pub(super) fn discard_open(&mut self) {
        self.open = 0;
    }

    /// Takes bytes off the front.
    pub(super) fn pop(&mut self, len: usize) {
        let len = len.min(self.queued);
        self.front = self.place(len);
        self.queued -= len;
    }

    pub(super) fn clear(&mut self) {
        self.queued = 0;
        self.open = 0;
    }

    /// A byte of the queue.
    pub(super) fn byte(&self, offset: usize) -> u8 {
        self.buffer[self.place(offset)]
    }

    /// The first bytes of the queue.
    pub(super) fn first<const N: usize>(&self) -> [u8; N] {
        self.at(0)
    }

    /// Bytes of the open block; those that have not arrived are any.
    pub(super) fn of_open<const N: usize>(&self, offset: usize) -> [u8; N] {
        self.at(self.queued + offset)
    }

    /// The first `len` bytes of the open block, in two pieces.
    pub(super) fn open_slices(&self, len: usize) -> [&[u8]; 2] {
        let from = self.place(self.queued);
        let first = len.min(self.buffer.len() - from);
        [&self.buffer[from..from + first], &self.buffer[..len - first]]
    }

    fn at<const N: usize>(&self, offset: usize) -> [u8; N] {
        let mut bytes = [0; N];
        self.fill(offset, &mut bytes);
        bytes
    }

    /// The work of `at` for every length: one copy of the code.
    fn fill(&self, offset: usize, bytes: &mut [u8]) {
        for (i, byte) in bytes.iter_mut().enumerate() {
            *byte = self.byte(offset + i);
        }
    }

    /// Offsets are less than twice the ring.
    fn place(&self, offset: usize) -> usize {
        let at = self.front + offset;
        if at >= self.buffer.len() {
            at - self.buffer.len()
        } else {
            at
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::vec::Vec;

    #[test]
    fn blocks_leave_in_order_across_the_end_of_the_ring() {
        let mut buffer = [0; 10];
        let mut queue = Queue::new(&mut buffer);
        for round in 0..20_u8 {
            assert!(queue.push(&[round; 3]));
            assert!(queue.push(&[round, 99, round]));
            assert_eq!(queue.open(), 6);
            assert_eq!(queue.of_open::<2>(3), [round, 99]);
            assert_eq!(queue.open_slices(6).concat(), [round, round, round, round, 99, round]);
            assert!(queue.is_empty(), "not before it is judged");
            queue.commit();
            assert!(!queue.push(&[0; 5]), "there is room for 4");
            assert_eq!(queue.open(), 0, "all or nothing");
            assert!(queue.push(&[7; 4]));
            assert_eq!(queue.free(), 0);
            queue.discard_open();
            assert_eq!(queue.free(), 4);
            let read: Vec<u8> = (0..6).map(|i| queue.byte(i)).collect();
            assert_eq!(read, [round, round, round, round, 99, round]);
            queue.pop(2);
            assert_eq!(queue.first::<3>(), [round, round, 99]);
            queue.pop(4);
            assert!(queue.is_empty());
        }
    }
}
