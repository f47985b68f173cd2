//! The pieces of programs that were received but are not in flash yet: a ring of bytes, which lets
//! the flash lag behind the bus.
//!
//! A piece is *open* while its bytes arrive. A format checks it, and then it either joins the queue
//! ([`Queue::commit`]) or is dropped ([`Queue::discard`]). In the ring each piece is its address,
//! its size and its bytes.

use crate::session::LastBlock;

/// The bytes before each piece's data.
pub(crate) const PIECE_HEADER: usize = 8;

/// The place of a piece in flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Piece {
    /// Flash address of the first byte.
    pub address: u32,
    /// Number of bytes, at least 1.
    pub size: u32,
}

/// A ring of bytes; its front is the oldest piece.
pub(crate) struct Queue<'b> {
    buffer: &'b mut [u8],
    front: usize,
    queued: usize,
    /// The size of the open piece in bytes, including its header; 0 without one.
    open: usize,
    /// The last block of data that was accepted.
    pub last: LastBlock,
}

impl<'b> Queue<'b> {
    pub(crate) fn new(buffer: &'b mut [u8]) -> Self {
        Self { buffer, front: 0, queued: 0, open: 0, last: LastBlock::none(0) }
    }

    pub(crate) fn into_buffer(self) -> &'b mut [u8] {
        self.buffer
    }

    pub(crate) fn capacity(&self) -> usize {
        self.buffer.len()
    }

    pub(crate) fn free(&self) -> usize {
        self.buffer.len() - self.queued - self.open
    }

    /// Whether no piece waits for the flash.
    pub(crate) fn is_empty(&self) -> bool {
        self.queued == 0
    }

    /// Data bytes of the open piece.
    pub(crate) fn open_size(&self) -> usize {
        self.open.saturating_sub(PIECE_HEADER)
    }

    /// Adds to the open piece, or opens one with this address. Adds all bytes or none; returns
    /// whether there was room.
    pub(crate) fn push(&mut self, address: u32, data: &[u8]) -> bool {
        if data.len() + PIECE_HEADER > self.free() {
            return false;
        }
        if self.open == 0 {
            self.open = PIECE_HEADER;
            self.set(self.queued, address);
        }
        for byte in data {
            let at = self.place(self.queued + self.open);
            self.buffer[at] = *byte;
            self.open += 1;
        }
        true
    }

    /// Adds bytes of a sealed image, which are not a piece ([`take`](Self::take)). Adds all bytes
    /// or none; returns whether there was room.
    pub(crate) fn push_bytes(&mut self, data: &[u8]) -> bool {
        if data.len() > self.free() {
            return false;
        }
        for byte in data {
            let at = self.place(self.queued);
            self.buffer[at] = *byte;
            self.queued += 1;
        }
        true
    }

    /// Removes bytes of a sealed image, as many as there are and fit; returns their number.
    pub(crate) fn take(&mut self, bytes: &mut [u8]) -> usize {
        let len = bytes.len().min(self.queued);
        for (i, byte) in bytes.iter_mut().take(len).enumerate() {
            *byte = self.byte(i);
        }
        self.front = self.place(len);
        self.queued -= len;
        len
    }

    /// Copies bytes of the open piece; returns whether there are enough.
    pub(crate) fn read_open(&self, offset: usize, bytes: &mut [u8]) -> bool {
        if self.open_size() < offset + bytes.len() {
            return false;
        }
        for (i, byte) in bytes.iter_mut().enumerate() {
            *byte = self.open_byte(offset + i);
        }
        true
    }

    /// A data byte of the open piece.
    pub(crate) fn open_byte(&self, offset: usize) -> u8 {
        self.byte(self.queued + PIECE_HEADER + offset)
    }

    /// The address of the open piece.
    pub(crate) fn open_address(&self) -> u32 {
        self.word(self.queued)
    }

    /// The first four bytes of the open piece, if it has that many.
    pub(crate) fn open_word(&self) -> u32 {
        self.word(self.queued + PIECE_HEADER)
    }

    /// The open piece is good: adds it to the queue.
    pub(crate) fn commit(&mut self) {
        let size = self.open_size();
        if size > 0 {
            self.set(self.queued + 4, size as u32);
            self.queued += self.open;
        }
        self.open = 0;
    }

    /// The open bytes are good and belong to a sealed image: adds them to the queue, not as a
    /// piece.
    pub(crate) fn commit_bytes(&mut self) {
        for _ in 0..self.open_size() {
            let at = self.place(self.queued);
            self.buffer[at] = self.byte(self.queued + PIECE_HEADER);
            self.queued += 1;
        }
        self.open = 0;
    }

    /// Drops the open piece.
    pub(crate) fn discard(&mut self) {
        self.open = 0;
    }

    /// Drops everything.
    pub(crate) fn clear(&mut self) {
        self.queued = 0;
        self.open = 0;
    }

    /// The oldest piece.
    pub(crate) fn first(&self) -> Option<Piece> {
        (self.queued > 0).then(|| Piece { address: self.word(0), size: self.word(4) })
    }

    /// A data byte of the oldest piece.
    pub(crate) fn data(&self, offset: usize) -> u8 {
        self.byte(PIECE_HEADER + offset)
    }

    /// Removes the oldest piece after it was written.
    pub(crate) fn pop(&mut self) {
        let len = (PIECE_HEADER + self.word(4) as usize).min(self.queued);
        self.front = self.place(len);
        self.queued -= len;
    }

    fn byte(&self, offset: usize) -> u8 {
        self.buffer[self.place(offset)]
    }

    fn word(&self, offset: usize) -> u32 {
        (0..4).rev().fold(0, |word, i| word << 8 | u32::from(self.byte(offset + i)))
    }

    fn set(&mut self, offset: usize, word: u32) {
        for (i, byte) in word.to_le_bytes().into_iter().enumerate() {
            let at = self.place(offset + i);
            self.buffer[at] = byte;
        }
    }

    /// Offsets are less than twice the size of the ring.
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
    fn pieces_leave_in_order_across_the_end_of_the_ring() {
        let mut buffer = [0; 31];
        let mut queue = Queue::new(&mut buffer);
        for round in 0..40_u8 {
            let address = 0x0801_0000 + u32::from(round);
            assert!(queue.push(address, &[round; 3]));
            assert!(queue.push(0, &[round, 99, round]), "the address is that of the first bytes");
            assert_eq!(queue.open_size(), 6);
            let mut bytes = [0; 2];
            assert!(queue.read_open(3, &mut bytes));
            assert_eq!((queue.open_address(), bytes), (address, [round, 99]));
            assert_eq!(queue.open_byte(4), 99);
            assert!(!queue.read_open(5, &mut bytes), "there are 6");
            assert!(queue.is_empty(), "not before it is judged");
            assert_eq!(queue.first(), None);
            queue.commit();
            assert!(!queue.push(1, &[0; 18]), "there is room for 17 with their header");
            assert_eq!(queue.open_size(), 0, "all or nothing");
            assert_eq!(queue.free(), 17);
            assert!(queue.push(1, &[7; 9]));
            assert_eq!(queue.free(), 0);
            queue.discard();
            assert_eq!(queue.free(), 17);
            assert_eq!(queue.first(), Some(Piece { address, size: 6 }));
            let read: Vec<u8> = (0..6).map(|i| queue.data(i)).collect();
            assert_eq!(read, [round, round, round, round, 99, round]);
            queue.pop();
            assert!(queue.is_empty());
            queue.commit();
            assert!(queue.is_empty(), "there was no open piece");
        }
    }
}
