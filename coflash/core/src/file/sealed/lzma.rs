//! Compression: raw LZMA with lc 0, lp 1 and pb 1, without header and end marker.
//!
//! Positions count from the start of the image. The dictionary, if there is one, lies before it. It
//! keeps the positions even: in a dictionary with an odd number of bytes, the first byte is never
//! used.

use std::io::{Read as _, Write as _};

use lzma_rust2::{EncodeMode, LzmaOptions, LzmaReader, LzmaWriter, MfType};

/// Literal context bits, literal position bits, position bits.
const LC_LP_PB: (u32, u32, u32) = (0, 1, 1);
/// The smallest window that LZMA has.
const LEAST: usize = 4096;

/// The usable part of a dictionary.
fn even(dictionary: &[u8]) -> &[u8] {
    &dictionary[dictionary.len() % 2..]
}

/// The window: the dictionary and the image.
fn window(size: usize, dictionary: &[u8]) -> Option<u32> {
    u32::try_from((size + dictionary.len()).max(LEAST)).ok()
}

/// Compresses an image; `None` if it is too large.
pub(super) fn compress(image: &[u8], dictionary: &[u8]) -> Option<Vec<u8>> {
    let dictionary = even(dictionary);
    let (lc, lp, pb) = LC_LP_PB;
    let mut options = LzmaOptions::with_preset(9);
    (options.lc, options.lp, options.pb) = (lc, lp, pb);
    (options.mode, options.mf) = (EncodeMode::Normal, MfType::Bt4);
    options.dict_size = window(image.len(), dictionary)?;
    options.preset_dict = (!dictionary.is_empty()).then(|| dictionary.to_vec());
    let mut writer = LzmaWriter::new_no_header(Vec::new(), &options, false).ok()?;
    writer.write_all(image).ok()?;
    writer.finish().ok()
}

/// Decompresses an image of `size` bytes; `None` if the payload does not give such an image.
pub(super) fn decompress(payload: &[u8], size: usize, dictionary: &[u8]) -> Option<Vec<u8>> {
    let dictionary = even(dictionary);
    let (lc, lp, pb) = LC_LP_PB;
    let preset = (!dictionary.is_empty()).then_some(dictionary);
    // The decoder does not get the length, because it would reduce the window to it.
    let window = window(size, dictionary)?;
    let mut reader = LzmaReader::new(payload, u64::MAX, lc, lp, pb, window, preset).ok()?;
    let mut image = vec![0; size];
    reader.read_exact(&mut image).ok()?;
    Some(image)
}

#[cfg(test)]
mod tests {
    use std::process::{Command, Stdio};

    use proptest::prelude::*;

    use super::*;

    /// Data with repetitions, like a program.
    fn program(size: usize, seed: u32) -> Vec<u8> {
        let mut state = seed | 1;
        let mut bytes = Vec::with_capacity(size);
        while bytes.len() < size {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let word = (state >> 24 & 0x1F | state >> 8 & 0xF000).to_le_bytes();
            bytes.extend_from_slice(&word[..2]);
        }
        bytes.truncate(size);
        bytes
    }

    /// `xz` has an independent decoder. It looks for an end marker, so it may decode the encoder's
    /// last bytes into data after the image.
    #[test]
    fn xz_decompresses_it() {
        let there = Command::new("xz").arg("--version").stdout(Stdio::null()).status();
        if there.is_err() {
            return;
        }
        for size in [1, 2, 100, 5000, 100_000] {
            let image = program(size, 7);
            let packed = compress(&image, &[]).unwrap();
            let mut xz = Command::new("xz")
                .args(["--format=raw", "--lzma1=lc=0,lp=1,pb=1,dict=1MiB", "-d", "-c", "-q"])
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            let mut input = xz.stdin.take().unwrap();
            let feeder = std::thread::spawn(move || input.write_all(&packed));
            let output = xz.wait_with_output().unwrap();
            feeder.join().unwrap().unwrap();
            assert!(output.stdout.starts_with(&image), "{size}: {}", output.stdout.len());
            assert!(output.stdout.len() < size + 300, "{size}: {}", output.stdout.len());
        }
    }

    #[test]
    fn a_program_becomes_smaller_and_with_its_predecessor_much_smaller() {
        let old = program(60_001, 3);
        let mut new = old.clone();
        new.splice(1000..1002, *b"inserted");
        let (alone, with) = (compress(&new, &[]).unwrap(), compress(&new, &old).unwrap());
        assert!(alone.len() < new.len() && with.len() < alone.len() / 20, "{} {}", alone.len(), with.len());
        assert_eq!(decompress(&with, new.len(), &old).as_deref(), Some(&new[..]));
        assert_ne!(decompress(&with, new.len(), &[]).as_deref(), Some(&new[..]));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn what_was_compressed_comes_back(
            image in prop::collection::vec(0_u8..4, 1..3000),
            dictionary in prop::collection::vec(0_u8..4, 0..9000),
        ) {
            let packed = compress(&image, &dictionary).unwrap();
            prop_assert_eq!(decompress(&packed, image.len(), &dictionary), Some(image));
        }

        #[test]
        fn anything_else_is_refused_without_a_panic(
            payload in prop::collection::vec(any::<u8>(), 0..600),
            size in 0_usize..5000,
        ) {
            let image = decompress(&payload, size, &[]);
            prop_assert!(image.is_none_or(|image| image.len() == size));
        }
    }
}
