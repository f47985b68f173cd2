//! The LZMA decoder against streams of `lzma-rust2`, and against hostile ones.

use std::io::Write;

use lzma_rust2::{EncodeMode, LzmaOptions, LzmaWriter};
use proptest::prelude::*;
use seal::lzma::{Corrupt, Decoder};

/// A raw stream with lc 0, lp 1, pb 1 and no end marker.
fn pack(data: &[u8], dictionary: &[u8], mode: EncodeMode) -> Vec<u8> {
    let options = LzmaOptions {
        lc: 0,
        lp: 1,
        pb: 1,
        mode,
        dict_size: 1 << 20,
        preset_dict: (!dictionary.is_empty()).then(|| dictionary.to_vec()),
        ..LzmaOptions::with_preset(6)
    };
    let mut writer = LzmaWriter::new_no_header(Vec::new(), &options, false).unwrap();
    writer.write_all(data).unwrap();
    writer.finish().unwrap()
}

/// Decompresses with `chunk` bytes of new input and room for `room` bytes of output at a time. The
/// history is everything that was decompressed, and the dictionary before it.
fn unpack(
    decoder: &mut Decoder,
    packed: &[u8],
    dictionary: &[u8],
    size: usize,
    chunk: usize,
    room: usize,
) -> Result<Vec<u8>, Corrupt> {
    let mut all = dictionary.to_vec();
    let end = dictionary.len() + size;
    let mut from = 0;
    let mut to = chunk.min(packed.len());
    // Each turn consumes input or gives output, or both, or gets more input.
    for _ in 0..2 * (packed.len() + size) + 2 {
        let mut out = vec![0; room.min(end - all.len())];
        let history = |back: u32| all[all.len() - back as usize];
        let last = to == packed.len();
        let (consumed, produced) =
            decoder.decode(&packed[from..to], last, all.len() as u32, &history, &mut out)?;
        assert!(produced <= out.len() && consumed <= to - from);
        from += consumed;
        all.extend(&out[..produced]);
        if all.len() == end {
            return (from == packed.len() && decoder.is_finished())
                .then(|| all.split_off(dictionary.len()))
                .ok_or(Corrupt);
        }
        if produced < room {
            assert!(!last, "with all input it either fills the room or refuses");
            to = packed.len().min(to + chunk);
        }
    }
    panic!("no end");
}

fn both_ways(data: &[u8], dictionary: &[u8], chunk: usize, room: usize) {
    for mode in [EncodeMode::Normal, EncodeMode::Fast] {
        let packed = pack(data, dictionary, mode);
        let unpacked = unpack(&mut Decoder::new(), &packed, dictionary, data.len(), chunk, room);
        assert!(unpacked.as_deref() == Ok(data), "{} bytes, {chunk}, {room}", data.len());
    }
}

/// The test program itself.
fn program() -> Vec<u8> {
    std::fs::read(std::env::current_exe().unwrap()).unwrap()
}

#[test]
fn a_program_in_chunks_of_any_size() {
    let data = &program()[..40_000];
    for size in (1..64).chain([100, 512, 1024, 4096, 100_000]) {
        both_ways(data, &[], size, 4096);
        both_ways(data, &[], 4096, size);
    }
}

#[test]
fn a_whole_program() {
    let data = program();
    both_ways(&data[..data.len().min(3_000_000)], &[], 4096, 2048);
}

/// An update: the same data with some inserted bytes, and a dictionary of odd and even size.
#[test]
fn the_former_program_is_the_dictionary() {
    let old = &program()[..100_001];
    let mut new = old.to_vec();
    (1..20).for_each(|n| new.insert(n * 4_999, n as u8));
    for dictionary in [old, &old[1..], &old[99_000..], &old[..1]] {
        both_ways(&new, dictionary, 512, 1024);
    }
    let packed = pack(&new, old, EncodeMode::Normal);
    assert!(packed.len() < 1000, "{} bytes: the dictionary is used", packed.len());
    // With another dictionary the result is another program, or an error.
    let other = vec![0; old.len()];
    let unpacked = unpack(&mut Decoder::new(), &packed, &other, new.len(), 512, 1024);
    assert!(unpacked.as_deref() != Ok(&new));
    assert_eq!(unpack(&mut Decoder::new(), &packed, &[], new.len(), 512, 1024), Err(Corrupt));
}

#[test]
fn after_a_reset_it_takes_another_stream() {
    let mut decoder = Decoder::new();
    let data = &program()[..9_999];
    for dictionary in [&data[..0], &data[..77], &data[..0]] {
        let packed = pack(data, dictionary, EncodeMode::Normal);
        decoder.reset();
        // The first stream is abandoned in the middle.
        assert!(unpack(&mut decoder, &packed[..500], dictionary, 9_999, 64, 64).is_err());
        decoder.reset();
        let unpacked = unpack(&mut decoder, &packed, dictionary, data.len(), 64, 64);
        assert!(unpacked.as_deref() == Ok(data));
    }
}

#[test]
fn each_stream_that_is_too_short_or_too_long_is_refused() {
    let data = &program()[..2_000];
    let packed = pack(data, &[], EncodeMode::Normal);
    for length in 0..packed.len() {
        let unpacked = unpack(&mut Decoder::new(), &packed[..length], &[], data.len(), 100, 100);
        assert_eq!(unpacked, Err(Corrupt), "{length}");
    }
    let longer = [&packed[..], &[0]].concat();
    assert_eq!(unpack(&mut Decoder::new(), &longer, &[], data.len(), 100, 100), Err(Corrupt));
    let mut other = packed;
    other[0] = 1;
    assert_eq!(unpack(&mut Decoder::new(), &other, &[], data.len(), 100, 100), Err(Corrupt));
}

/// All input is consumed and all expected bytes are there, and yet it is not the end.
#[test]
fn a_stream_that_does_not_end_where_it_should_is_refused() {
    let data = &program()[..2_000];
    let mut packed = pack(data, &[], EncodeMode::Normal);
    // The lowest bits of the last number are 0, and decide on no symbol.
    *packed.last_mut().unwrap() ^= 1;
    assert_eq!(unpack(&mut Decoder::new(), &packed, &[], data.len(), 100, 100), Err(Corrupt));
    // The last symbol is a copy, of which one byte is too many.
    let run = [&b"start"[..], &[b'!'; 200]].concat();
    let packed = pack(&run, &[], EncodeMode::Normal);
    assert_eq!(unpack(&mut Decoder::new(), &packed, &[], run.len() - 1, 100, 300), Err(Corrupt));
}

#[test]
fn with_24_bytes_of_input_it_goes_on() {
    let packed = pack(&program()[..2_000], &[], EncodeMode::Normal);
    for (have, goes_on) in [(23, false), (24, true)] {
        let mut out = [0; 100];
        let done = Decoder::new().decode(&packed[..have], false, 0, &|_| 0, &mut out).unwrap();
        assert_eq!(done != (0, 0), goes_on, "{have}");
    }
}

#[test]
fn an_end_marker_is_no_part_of_a_stream() {
    let options = LzmaOptions { lc: 0, lp: 1, pb: 1, ..LzmaOptions::with_preset(6) };
    let mut writer = LzmaWriter::new_no_header(Vec::new(), &options, true).unwrap();
    writer.write_all(b"some bytes").unwrap();
    let packed = writer.finish().unwrap();
    assert_eq!(unpack(&mut Decoder::new(), &packed, &[], 11, 100, 100), Err(Corrupt));
    assert_eq!(unpack(&mut Decoder::new(), &packed, &[], 10, 100, 100), Err(Corrupt));
}

/// Bytes of a small alphabet with copies in them, so that every kind of symbol occurs.
fn data() -> impl Strategy<Value = Vec<u8>> {
    let piece = (prop::collection::vec(any::<u8>(), 0..20), 1..4000_usize, 0..300_usize);
    prop::collection::vec(piece, 0..60).prop_map(|pieces| {
        let mut data = Vec::new();
        for (bytes, back, length) in pieces {
            data.extend(bytes);
            for _ in 0..length {
                let at = data.len().saturating_sub(back);
                data.push(data.get(at).copied().unwrap_or(0));
            }
        }
        data.push(0);
        data
    })
}

proptest! {
    #[test]
    fn any_data_any_dictionary_any_sizes(
        data in data(),
        dictionary in prop_oneof![Just(Vec::new()), data()],
        chunk in 1..200_usize,
        room in 1..200_usize,
    ) {
        both_ways(&data, &dictionary, chunk, room);
    }

    /// No panic, no endless loop, nothing after `out`: `unpack` asserts it.
    #[test]
    fn hostile_bytes(
        bytes in prop::collection::vec(any::<u8>(), 0..2000),
        dictionary in prop::collection::vec(any::<u8>(), 0..50),
        size in 1..5000_usize,
        chunk in 1..200_usize,
        room in 1..200_usize,
    ) {
        let stream = [&[0], &bytes[..]].concat();
        let _ = unpack(&mut Decoder::new(), &stream, &dictionary, size, chunk, room);
    }

    #[test]
    fn hostile_changes(
        data in data(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        chunk in 1..200_usize,
        room in 1..200_usize,
    ) {
        let mut stream = pack(&data, &[], EncodeMode::Fast);
        for (at, value) in changes {
            let at = at.index(stream.len());
            stream[at] = value;
        }
        let _ = unpack(&mut Decoder::new(), &stream, &[], data.len(), chunk, room);
    }
}
