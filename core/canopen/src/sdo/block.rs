//! Block transfer, for server and client: the CRC, and the receiving end (CiA 301 section 7.2.4.3.9
//! ff.).

use crate::abort::AbortCode;
use crate::sdo::fields;
use crate::sdo::wire::Chunk;

/// Segments in the largest sub-block.
pub const BLKSIZE_MAX: u8 = 127;

/// Bytes of a segment.
pub(super) const SEGMENT: usize = 7;

/// CRC-16 of the block transfer (CiA 301 section 7.2.4.3.16): polynomial 1021h, start value 0, not
/// reflected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Crc16(u16);

impl Crc16 {
    /// The CRC of no data.
    #[must_use]
    pub const fn new() -> Self {
        Self(0)
    }

    /// Adds data, bit by bit: this takes 88 bytes of code where a table takes 512, and a CAN bus
    /// carries at most 60 kB/s.
    pub fn update(&mut self, data: &[u8]) {
        for byte in data {
            self.0 ^= u16::from(*byte) << 8;
            for _ in 0..8 {
                let carry = self.0 & 0x8000 != 0;
                self.0 <<= 1;
                if carry {
                    self.0 ^= 0x1021;
                }
            }
        }
    }

    /// The CRC of all data so far.
    #[must_use]
    pub const fn get(self) -> u16 {
        self.0
    }
}

/// Checks that a block size is valid: 1 to 127.
pub(super) fn check_blksize(blksize: u8) -> Result<u8, AbortCode> {
    match blksize {
        1..=BLKSIZE_MAX => Ok(blksize),
        _ => Err(AbortCode::BLOCK_SIZE),
    }
}

/// The receiving end: takes segments that come in order, and decides when to acknowledge.
///
/// A segment out of order is ignored. The acknowledgement of the sub-block makes the other side
/// send it again.
#[derive(Debug)]
pub(super) struct Receiver {
    /// The number of segments of the open sub-block; 0 while none is open, because an
    /// acknowledgement must be sent first.
    blksize: u8,
    /// The number of the last segment received in order.
    ackseq: u8,
    /// The number of the last received segment of this sub-block; 0 before the first one.
    seen: u8,
    /// Until the first segment of this sub-block has arrived, numbers in this range (first and last)
    /// belong to the previous sub-block: its last segment again; or its rest, if it was acknowledged
    /// early and the other side reads the acknowledgement only after it has sent everything.
    old: (u8, u8),
    /// The last received frame.
    pub frame: [u8; 8],
    /// That frame may not be a segment.
    pub is_doubtful: bool,
    /// That frame is the last segment of the transfer. The end of the transfer contains the number
    /// of its data bytes.
    is_complete: bool,
    /// `None` if one side does not support the CRC.
    crc: Option<Crc16>,
}

/// The consequence of a segment.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Received {
    /// The segment is in order and not the last one: its seven bytes are data.
    pub is_data: bool,
    /// The sub-block has ended: acknowledge up to this segment.
    pub ackseq: Option<u8>,
}

impl Received {
    const NOTHING: Self = Self { is_data: false, ackseq: None };
}

impl Receiver {
    /// A receiver without an open sub-block. It computes the CRC if both sides support it.
    pub fn new(crc: bool) -> Self {
        Self {
            blksize: 0,
            ackseq: 0,
            seen: 0,
            old: (0, 0),
            frame: [0; 8],
            is_doubtful: false,
            is_complete: false,
            crc: crc.then(Crc16::new),
        }
    }

    /// Opens the next sub-block of 1 to 127 segments, after the frame that grants it was sent.
    pub fn open(&mut self, blksize: u8) {
        self.blksize = blksize;
        self.ackseq = 0;
        self.seen = 0;
    }

    /// Whether the last segment has arrived, so that only the end is missing.
    pub fn is_complete(&self) -> bool {
        self.is_complete
    }

    /// Whether a sub-block has begun and not ended. If no more segments arrive, its end was lost.
    pub fn is_within(&self) -> bool {
        self.seen != 0 && self.blksize != 0
    }

    /// The number that follows the last received segment of this sub-block, or of the previous one.
    fn successor(&self) -> u8 {
        if self.seen == 0 {
            self.old.0
        } else {
            self.seen + 1
        }
    }

    /// The number of the segment that the other side sends next, if none was lost; `None` after the last
    /// one of the transfer. A new sub-block begins if the previous one came to its end.
    pub fn due(&self) -> Option<u8> {
        let is_new = self.seen == 0 && self.old.0 == self.old.1;
        let next = if is_new || self.is_doubtful { self.ackseq + 1 } else { self.successor() };
        (!self.is_complete).then_some(next)
    }

    /// Whether no segment is missing before the last received one.
    pub fn is_in_order(&self) -> bool {
        self.ackseq == self.seen
    }

    /// Whether the last segment of the sub-block is the next one.
    pub fn misses_one(&self) -> bool {
        self.seen + 1 == self.blksize
    }

    /// Ends the sub-block early; returns the number of the segment to acknowledge.
    pub fn close(&mut self) -> u8 {
        self.old = (self.seen + 1, self.blksize);
        self.blksize = 0;
        self.is_doubtful = false;
        self.ackseq
    }

    /// Processes the frame of a segment.
    ///
    /// The other side sends the segments of a sub-block in a row: the next one in order, the
    /// successor of the last received one, or the last one of the sub-block. (Before the first one
    /// it may still be sending the previous sub-block.) A server must also expect an initiate: for
    /// it, any other frame that reads as an initiate is `doubtful`. If such a frame is a segment
    /// after all, its successor follows it.
    ///
    /// # Errors
    /// [`AbortCode::SEQUENCE_NUMBER`] for number 0 and for a number above the block size.
    pub fn take(&mut self, frame: &[u8; 8], doubtful: bool) -> Result<Received, AbortCode> {
        let last = frame[0] & fields::LAST_OF_BLOCKS != 0;
        let seqno = frame[0] & !fields::LAST_OF_BLOCKS;
        if seqno == 0 {
            return Err(AbortCode::SEQUENCE_NUMBER);
        }
        let in_order = seqno == self.ackseq + 1;
        // CAN repeats a frame if its end was disturbed. Before the first segment of a sub-block it may be
        // a client that repeats a request, which was taken for the rest of the previous one.
        if !in_order && self.frame == *frame {
            self.is_doubtful |= doubtful && self.seen == 0 && fields::may_initiate(frame[0]);
            return Ok(Received::NOTHING);
        }
        self.frame = *frame;
        let in_row = in_order || seqno == self.successor() || seqno == self.blksize;
        self.is_doubtful = doubtful && !in_row && fields::may_initiate(frame[0]);
        if self.is_doubtful {
            if self.seen != 0 {
                self.seen = seqno;
            }
            return Ok(Received::NOTHING);
        }
        let old = !in_order && self.seen == 0 && (self.old.0..=self.old.1).contains(&seqno);
        if old {
            self.old.0 = self.old.1.min(seqno + 1);
        }
        if self.blksize == 0 || old {
            return Ok(Received::NOTHING);
        }
        if seqno > self.blksize {
            return Err(AbortCode::SEQUENCE_NUMBER);
        }
        self.seen = seqno;
        let mut received = Received::NOTHING;
        if in_order {
            self.ackseq = seqno;
            if last {
                self.is_complete = true;
            } else {
                self.count(&frame[1..]);
                received.is_data = true;
            }
        }
        if last || seqno == self.blksize {
            self.blksize = 0;
            self.old = (seqno, seqno);
            received.ackseq = Some(self.ackseq);
        }
        Ok(received)
    }

    fn count(&mut self, data: &[u8]) {
        if let Some(crc) = &mut self.crc {
            crc.update(data);
        }
    }

    /// Whether a frame repeats the last segment of the transfer, where the end is expected.
    pub fn is_last_segment(&self, frame: &[u8; 8]) -> bool {
        self.is_complete && self.frame == *frame
    }

    /// Processes the end, with the number of bytes of the last segment that are not data, and the
    /// CRC. Returns the data of the last segment.
    ///
    /// # Errors
    /// [`AbortCode::COMMAND`] before the last segment, [`AbortCode::CRC`] for a wrong CRC.
    pub fn finish(&mut self, unused: u8, crc: u16) -> Result<Chunk<SEGMENT>, AbortCode> {
        if !self.is_complete {
            return Err(AbortCode::COMMAND);
        }
        let data = Chunk::with_unused(&self.frame[1..], unused);
        self.count(&data);
        match self.crc {
            Some(computed) if computed.get() != crc => Err(AbortCode::CRC),
            _ => Ok(data),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sdo::wire::BlockSegment;

    /// CiA 301 section 7.2.4.3.16 gives the CRC of "123456789" as 31C3h.
    #[test]
    fn crc_of_the_standards_example() {
        let mut crc = Crc16::new();
        crc.update(b"12345");
        crc.update(b"6789");
        assert_eq!(crc.get(), 0x31C3);
        assert_eq!(Crc16::new().get(), 0);
    }

    fn segment(last: bool, seqno: u8) -> [u8; 8] {
        BlockSegment { last, seqno, data: [seqno; 7] }.emit()
    }

    const NOTHING: Received = Received::NOTHING;
    const DATA: Received = Received { is_data: true, ackseq: None };

    #[test]
    fn a_gap_is_acknowledged_up_to_the_gap_at_the_end_of_the_sub_block() {
        let mut receiver = Receiver::new(false);
        receiver.open(4);
        assert_eq!(receiver.take(&segment(false, 1), true), Ok(DATA));
        assert_eq!(receiver.take(&segment(false, 3), true), Ok(NOTHING));
        assert_eq!(receiver.take(&segment(false, 4), true), Ok(Received { is_data: false, ackseq: Some(1) }));
        // Between the acknowledgement and the next sub-block, segments do not count.
        assert_eq!(receiver.take(&segment(false, 1), true), Ok(NOTHING));
        receiver.open(4);
        // The end of the old sub-block again.
        assert_eq!(receiver.take(&segment(false, 4), true), Ok(NOTHING));
        assert!(!receiver.is_within());
        assert_eq!(receiver.take(&segment(false, 1), true), Ok(DATA));
        assert!(receiver.is_within());
        assert_eq!(receiver.take(&segment(false, 1), true), Ok(NOTHING));
        assert_eq!(receiver.take(&segment(true, 2), true), Ok(Received { is_data: false, ackseq: Some(2) }));
        assert!(receiver.is_complete());
        assert!(receiver.is_last_segment(&segment(true, 2)));
        assert!(!receiver.is_last_segment(&segment(false, 2)));
        let tail = receiver.finish(5, 0xFFFF).unwrap();
        assert_eq!(*tail, [2, 2]);
    }

    /// The other side sends segments 3 and 4 of the sub-block before it reads that 2 were acknowledged.
    #[test]
    fn the_rest_of_a_sub_block_that_was_closed_early_is_none_of_the_next() {
        let behind_two_of = |blksize| {
            let mut receiver = Receiver::new(false);
            receiver.open(blksize);
            assert_eq!(receiver.take(&segment(false, 1), true), Ok(DATA));
            assert_eq!(receiver.take(&segment(false, 2), true), Ok(DATA));
            assert_eq!(receiver.close(), 2);
            receiver.open(blksize);
            receiver
        };
        for (seqno, is_of_the_next) in [(2, true), (3, false), (4, false)] {
            let mut receiver = behind_two_of(4);
            let other = BlockSegment { last: false, seqno, data: [0xEE; 7] }.emit();
            assert_eq!(receiver.take(&other, false).map(|received| received.is_data), Ok(false));
            assert_eq!(receiver.is_within(), is_of_the_next, "{seqno}");
        }
        // After segment 3 of the rest, another 3 is the next sub-block's.
        let mut receiver = behind_two_of(6);
        for (content, is_of_the_next) in [(0xEE, false), (0xDD, true)] {
            let segment = BlockSegment { last: false, seqno: 3, data: [content; 7] }.emit();
            assert_eq!(receiver.take(&segment, false), Ok(NOTHING));
            assert_eq!(receiver.is_within(), is_of_the_next);
        }
    }

    /// After a lost segment 30, number 32 reads as an initiate (20h), and follows 31.
    #[test]
    fn the_successor_of_the_last_segment_is_one_also_behind_a_gap() {
        let mut receiver = Receiver::new(false);
        receiver.open(127);
        for seqno in 1..=29 {
            assert_eq!(receiver.take(&segment(false, seqno), true), Ok(DATA));
        }
        for seqno in [31, 32] {
            assert_eq!(receiver.take(&segment(false, seqno), true), Ok(NOTHING));
            assert!(!receiver.is_doubtful, "{seqno}");
        }
        // 34 follows no 33.
        assert_eq!(receiver.take(&segment(false, 34), true), Ok(NOTHING));
        assert!(receiver.is_doubtful);
    }

    #[test]
    fn a_number_above_the_block_size_is_none() {
        let mut receiver = Receiver::new(false);
        receiver.open(4);
        assert_eq!(receiver.take(&segment(false, 5), true), Err(AbortCode::SEQUENCE_NUMBER));
        assert_eq!(receiver.finish(0, 0), Err(AbortCode::COMMAND));
    }

    #[test]
    fn a_sub_block_of_one_segment_may_be_followed_by_the_same() {
        let mut receiver = Receiver::new(false);
        for _ in 0..3 {
            receiver.open(1);
            let taken = receiver.take(&segment(false, 1), true).unwrap();
            assert_eq!(taken, Received { is_data: true, ackseq: Some(1) });
        }
    }
}
