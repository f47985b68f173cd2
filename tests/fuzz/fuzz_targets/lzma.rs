//! The decompressor of sealed images, with any input in chunks of any size.
//!
//! Must hold: it consumes no more than the input, gives no more than there is room for, reads no
//! byte before the first one, and ends.
#![cfg_attr(fuzzing, no_main)]

use seal::lzma::Decoder;

/// The largest size of the image.
const IMAGE: usize = 1 << 16;

coboot_fuzz::target!(|bytes: &[u8]| {
    let [room, chunk, dictionary, stream @ ..] = bytes else { return };
    let (room, chunk) = (usize::from(*room) + 1, usize::from(*chunk) + 24);
    let mut image = vec![0x5A; usize::from(*dictionary)];
    let mut decoder = Box::new(Decoder::new());
    decoder.reset();
    let (mut from, mut to) = (0, chunk.min(stream.len()));
    while image.len() < IMAGE {
        let last = to == stream.len();
        let mut out = vec![0; room];
        let before = |distance: u32| image[image.len() - distance as usize];
        let len = image.len() as u32;
        let Ok((taken, given)) = decoder.decode(&stream[from..to], last, len, &before, &mut out) else {
            return;
        };
        assert!(taken <= to - from && given <= room);
        from += taken;
        image.extend_from_slice(&out[..given]);
        if given == 0 {
            if last {
                return;
            }
            to = (to + chunk).min(stream.len());
        }
    }
});
