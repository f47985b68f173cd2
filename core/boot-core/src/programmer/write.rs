//! Writes a piece from the queue into flash.

use shared_abi::geometry::Region;

use crate::flash::{Flash, FlashFault, Operation};
use crate::queue::Piece;
use crate::sequence::ProgramWords;

/// The words of a piece that is being programmed. Flash is programmed in words: the first and the
/// last one are completed with the existing bytes.
pub(super) struct WritePiece {
    piece: Piece,
    /// The existing first and last word.
    edges: [u32; 2],
    words: ProgramWords,
}

impl WritePiece {
    /// `None` if its place is not erased. With `again`, some of the data may already be in flash:
    /// each word is written once more, and reading it back shows whether it was the same.
    pub(super) fn new<F: Flash>(flash: &F, piece: Piece, again: bool) -> Option<Self> {
        let place = Region::new(piece.address, piece.size);
        if !again && !flash.is_blank(place) {
            return None;
        }
        let (first, last) = (place.base & !3, (place.end() - 1) & !3);
        let edges = [flash.read_word(first), flash.read_word(last)];
        Some(Self { piece, edges, words: ProgramWords::new(first) })
    }

    /// The address of the word whose turn it is.
    pub(super) const fn at(&self) -> u32 {
        self.words.at()
    }

    /// The next operation, `None` when the whole piece is in flash and was read back.
    pub(super) fn next<F: Flash>(
        &mut self,
        flash: &F,
        data: impl Fn(usize) -> u8,
    ) -> Result<Option<Operation>, FlashFault> {
        let (piece, edges) = (self.piece, self.edges);
        let before = piece.address as usize % 4;
        let size = piece.size as usize;
        let count = (before + size).div_ceil(4);
        self.words.next(flash, count, |word| {
            let there = edges[usize::from(word + 1 == count)].to_le_bytes();
            let mut bytes = if word == 0 || word + 1 == count { there } else { [0; 4] };
            for (i, byte) in bytes.iter_mut().enumerate() {
                let offset = (4 * word + i).wrapping_sub(before);
                if offset < size {
                    *byte = data(offset);
                }
            }
            u32::from_le_bytes(bytes)
        })
    }
}
