//! The block file's sizes (manual L-1112, chapter 5.1).

use shared_abi::block_file::{CRC_SIZE, FRAMING, HEADER_SIZE};

/// Three words are before the data, one is after them.
#[test]
fn a_block_has_four_words_that_are_no_data() {
    assert_eq!((HEADER_SIZE, CRC_SIZE, FRAMING), (12, 4, 16));
}
