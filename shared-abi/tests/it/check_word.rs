//! The check word of cell, handoff and label: its values are part of the ABI.

use shared_abi::check_word;

/// Seed C0B007A5h; for each word: rotated left by 5, exclusive or with the word, times 9E3779B1h; at the
/// end inverted. Worked out by a program that shares nothing with this crate (Python's integers).
#[test]
fn it_is_that_of_the_abi() {
    assert_eq!(check_word(&[]), !0xC0B0_07A5);
    assert_eq!(check_word(&[0]), 0x3223_D4C7);
    assert_eq!(check_word(&[1, 2, 3]), 0x6A9F_A61F);
}
