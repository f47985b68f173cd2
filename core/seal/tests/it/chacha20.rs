//! ChaCha20 against RFC 8439 and the crate `chacha20`.

use crate::hex::hex;
use chacha20::cipher::{KeyIvInit, StreamCipher, StreamCipherSeek};
use proptest::prelude::*;
use seal::chacha20::apply;

/// RFC 8439, 2.4.2.
#[test]
fn the_example_of_rfc_8439() {
    let key: Vec<u8> = (0..32).collect();
    let mut text = b"Ladies and Gentlemen of the class of '99: If I could offer you only one tip for \
        the future, sunscreen would be it."
        .to_vec();
    apply(key[..].try_into().unwrap(), &[0, 0, 0, 0, 0, 0, 0, 0x4a, 0, 0, 0, 0], 1, &mut text);
    assert_eq!(
        text,
        hex("6e 2e 35 9a 25 68 f9 80 41 ba 07 28 dd 0d 69 81
             e9 7e 7a ec 1d 43 60 c2 0a 27 af cc fd 9f ae 0b
             f9 1b 65 c5 52 47 33 ab 8f 59 3d ab cd 62 b3 57
             16 39 d6 24 e6 51 52 ab 8f 53 0c 35 9f 08 61 d8
             07 ca 0d bf 50 0d 6a 61 56 a3 8e 08 8a 22 b6 5e
             52 bc 51 4d 16 cc f8 06 81 8c e9 1a b7 79 37 36
             5a f9 0b bf 74 a3 5b e6 b4 0b 8e ed f2 78 5e 42
             87 4d")
    );
}

proptest! {
    #[test]
    fn any_data_agree_with_the_crate(
        key: [u8; 32],
        nonce: [u8; 12],
        counter in 0_u32..0xffff_0000,
        data in prop::collection::vec(any::<u8>(), 0..1000),
    ) {
        let mut ours = data.clone();
        apply(&key, &nonce, counter, &mut ours);
        let mut theirs = data;
        let mut cipher = chacha20::ChaCha20::new(&key.into(), &nonce.into());
        cipher.seek(u64::from(counter) * 64);
        cipher.apply_keystream(&mut theirs);
        prop_assert_eq!(ours, theirs);
    }
}
