//! The bootloader's image: the linker's image and the compressed one are equal, every loader writes
//! it to the right place, and an image that is damaged in flash does not run.

mod gdb;
mod zx0;

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{press, Bench, NODE};
use coboot_tests::firmware;
use coflash::update::{flash, FlashOptions};
use crc::{Crc, CRC_32_ISO_HDLC};
use emulator::machine::{ResetCause, Stop};
use emulator::time::Span;
use object::elf::{FileHeader32, PT_LOAD};
use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{Endianness, Object, ObjectSection};
use shared_abi::geometry::Region;
use shared_abi::ram_image::SERVICES_VERSION;

/// The size of the header in bytes (shared_abi::ram_image, typed again).
const HEADER: usize = 24;

fn words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect()
}

fn crc32(bytes: &[u8]) -> u32 {
    Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(bytes)
}

/// A bootloader in flash, with the places of its parts.
struct Packed {
    /// The bytes from the start of the flash.
    flash: Vec<u8>,
    /// Offset of the header of the RAM image.
    header: usize,
    /// The decompressed image.
    ram: Vec<u8>,
}

impl Packed {
    fn of(image: &str) -> Self {
        let elf = firmware::elf(image);
        let base = firmware::board().bootloader.base;
        let mut flash = Vec::new();
        for name in [".vector_table", ".callgate", ".boot", ".ram_image", ".ram_image.packed"] {
            let (address, data) = firmware::section(&elf, name);
            let at = (address - base) as usize;
            assert!(at >= flash.len(), "{name} overlaps the section before");
            flash.resize(at, 0xFF);
            flash.extend(data);
        }
        let header = (firmware::section(&elf, ".ram_image").0 - base) as usize;
        Self { flash, header, ram: firmware::section(&elf, ".data").1 }
    }

    /// The stored bytes.
    fn stored(&mut self) -> &mut [u8] {
        &mut self.flash[self.header + HEADER..]
    }

    /// A word of the header.
    fn set(&mut self, word: usize, value: u32) {
        let at = self.header + word * 4;
        self.flash[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }

    fn get(&self, word: usize) -> u32 {
        words(&self.flash[self.header..self.header + HEADER])[word]
    }

    /// The bytes before the header.
    fn front(&self) -> &[u8] {
        &self.flash[..self.header]
    }

    /// The correct CRC: of the flash without the first two words of the header.
    fn right_crc(&self) -> u32 {
        crc32(&[self.front(), &self.flash[self.header + 8..]].concat())
    }

    /// Corrects the CRC.
    fn seal(&mut self) {
        self.set(CRC, self.right_crc());
    }
}

/// Removes the address from the target of each call (`shared_abi::ram_image::Method::Zx0`), with
/// numbers of 44 bits; returns the number of calls.
fn restore_calls(image: &mut [u8], base: u32) -> usize {
    let (mut at, mut calls) = (0, 0);
    while at + 4 <= image.len() {
        let pair = u32::from_le_bytes(image[at..at + 4].try_into().unwrap());
        if pair & 0xF800_F800 == 0xF800_F000 {
            let target = u64::from(pair & 0x7FF) * 0x800 + u64::from(pair >> 16 & 0x7FF);
            let here = (u64::from(base) + at as u64 + 2) / 2;
            let distance = ((1 << 44) + target - here) % (1 << 22);
            let pair = 0xF800_F000 | (distance % 0x800) << 16 | (distance / 0x800);
            image[at..at + 4].copy_from_slice(&(pair as u32).to_le_bytes());
            (at, calls) = (at + 2, calls + 1);
        }
        at += 2;
    }
    calls
}

/// The words of the header by number.
const MAGIC: usize = 0;
const CRC: usize = 1;
const SERVICES: usize = 2;
const METHOD: usize = 3;
const STORED: usize = 4;
const UNPACKED: usize = 5;

/// With offsets in bytes, our decoder of the format agrees with a foreign decompressor.
#[test]
fn the_format() {
    // Four literals; 5 from two before; one literal; 2 from the last offset; the end.
    let stream = [0x0E, b'a', b'b', b'c', b'd', 126 << 1, 0x28, b'X', 0xD5, 0x55, 0x60];
    let unpacked = zx0decompress::decompress(&mut stream.as_slice()).unwrap();
    assert_eq!(unpacked, b"abcdcdcdcXcX");
    assert_eq!(zx0::unpack(&[], &stream, zx0::BYTES), Some(unpacked));
    assert_eq!(zx0::unpack(&[], &stream[..10], zx0::BYTES), None, "without its end");
}

#[test]
fn what_is_packed_is_what_was_linked() {
    for image in [firmware::BOOTLOADER, firmware::BOOTLOADER_LEAST] {
        let mut packed = Packed::of(image);
        let (stored, ram) = (packed.stored().to_vec(), packed.ram.len());
        assert_eq!(packed.get(MAGIC), u32::from_le_bytes(*b"CBI1"));
        assert_eq!([packed.get(SERVICES), packed.get(METHOD)], [SERVICES_VERSION, 1]);
        assert_eq!([packed.get(STORED), packed.get(UNPACKED)], [stored.len() as u32, ram as u32]);
        assert_eq!(packed.get(CRC), packed.right_crc());
        // By the description of the format, with our own offsets and the calls restored.
        let mut unpacked = zx0::unpack(packed.front(), &stored, zx0::HALF_WORDS).unwrap();
        let calls = restore_calls(&mut unpacked, firmware::board().ram.base);
        assert!(unpacked == packed.ram, "{image}");
        assert!(calls > 100, "{image}: {calls} calls");
        assert!(stored.len() * 100 < ram * 85, "{image}: {} of {ram} bytes", stored.len());
    }
}

/// The flash contains the 16 vectors of the core; the RAM image begins with all vectors.
#[test]
fn vectors() {
    let board = firmware::board();
    let packed = Packed::of(firmware::BOOTLOADER);
    let in_flash = words(&packed.flash[..64]);
    assert_eq!(packed.flash[64..68], *b"CBCG", "the callgate is behind them");
    assert_eq!(in_flash[0], board.ram.end());
    for vector in &in_flash[1..] {
        assert!(vector & 1 == 1 && board.bootloader.contains(vector & !1, 2), "{vector:#x}");
    }
    let in_ram = words(&packed.ram[..board.chip.vector_table_size() as usize]);
    assert_eq!(in_ram[..2], in_flash[..2]);
    // No handler is in flash, because the flash may be busy. Some interrupts have no handler.
    let handlers: Vec<_> = in_ram[2..].iter().filter(|vector| **vector != 0).collect();
    assert!(handlers.iter().all(|vector| board.ram.contains(**vector & !1, 2)), "{in_ram:x?}");
    assert!(handlers.len() > 80);
    let (address, _) = firmware::section(&firmware::elf(firmware::BOOTLOADER), ".data");
    assert_eq!(address, board.ram.base);
}

/// By the rule of probe-rs: segments with contents, at their physical address, if a section lies in
/// them.
#[test]
fn probe_rs_loads_it() {
    let elf = firmware::elf(firmware::BOOTLOADER);
    let file = ElfFile32::<Endianness>::parse(&*elf).unwrap();
    let header = FileHeader32::<Endianness>::parse(&*elf).unwrap();
    let endian = Endianness::Little;
    let base = firmware::board().bootloader.base;
    let mut flash = vec![0xFF; firmware::board().bootloader.size as usize];
    for segment in header.program_headers(endian, &*elf).unwrap() {
        let range = u64::from(segment.p_offset(endian))..;
        let end = range.start + u64::from(segment.p_filesz(endian));
        let holds_a_section = file.sections().any(|section| {
            section.file_range().is_some_and(|(at, size)| at >= range.start && at + size <= end && size > 0)
        });
        if segment.p_type(endian) == PT_LOAD && segment.p_filesz(endian) > 0 && holds_a_section {
            let at = (segment.p_paddr(endian) - base) as usize;
            let data = segment.data(endian, &*elf).unwrap();
            flash[at..at + data.len()].copy_from_slice(data);
        }
    }
    let packed = Packed::of(firmware::BOOTLOADER).flash;
    assert!(flash[..packed.len()] == packed);
    assert!(flash[packed.len()..].iter().all(|byte| *byte == 0xFF));
}

/// gdb itself, connected to a stub that has only memory.
#[test]
fn gdb_loads_it_and_finds_symbols_in_ram() {
    let board = firmware::board();
    let commands = [
        "load",
        // Reads back what it wrote, section by section.
        "compare-sections",
        "info address main",
        "info line bootloader::app::idle",
    ];
    let run = gdb::run(&firmware::dir().join(firmware::BOOTLOADER), &commands);
    let said = &run.said;
    let packed = Packed::of(firmware::BOOTLOADER).flash;
    let flash = run.memory(board.bootloader.base, packed.len());
    assert!(flash == packed, "gdb wrote something else:\n{said}");
    let beyond = Region::new(board.bootloader.base, packed.len() as u32);
    let flash = board.chip.flash;
    assert!(run.written().all(|address| beyond.contains(address, 1) || !flash.contains(address, 1)));
    assert!(said.contains(".ram_image.packed") && !said.contains("MIS-MATCHED"), "{said}");
    let main = said.split_once("Symbol \"main\" is at 0x").unwrap_or_else(|| panic!("{said}")).1;
    let main = u32::from_str_radix(&main[..8], 16).unwrap();
    assert!(board.ram.contains(main, 2), "{main:#x}");
    assert!(said.contains("of \"bootloader/src/main.rs\" starts at address 0x2"), "{said}");
}

// --- on the emulated board
// -------------------------------------------------------------------------------------------------

/// A board with version 1 of the application, switched off.
fn board_with_a_program() -> Bench {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    flash(
        &mut bench.session(),
        &firmware::blocks(firmware::APP_V1),
        &FlashOptions::default().trial_run(false),
        &mut |_| {},
    )
    .unwrap();
    bench.confirm_program();
    bench.power_off();
    bench
}

fn load(bench: &mut Bench, image: &[u8]) {
    bench.machine().load_bin(firmware::board().bootloader.base, image).unwrap();
}

/// The warm-start cell as a debugger reads it: request and argument, if it is valid.
fn cell(bench: &Bench) -> Option<(u32, u32)> {
    let mut bytes = [0; 16];
    bench.world.machine(bench.device).read_memory(firmware::board().warm_start.base, &mut bytes).unwrap();
    let [magic, request, argument, check] = words(&bytes)[..] else { unreachable!("16 bytes") };
    // The fold of the ABI, implemented again.
    let fold = |fold: u32, word: &u32| (fold.rotate_left(5) ^ word).wrapping_mul(0x9E37_79B1);
    let sound = check == !words(&bytes)[..3].iter().fold(0xC0B0_07A5, fold);
    (magic == u32::from_le_bytes(*b"CBW1") && sound).then_some((request, argument))
}

/// The request that reports a damaged image, and its arguments.
const DAMAGED: u32 = 8;
const BY_HEADER: u32 = 1;
const BY_SERVICES: u32 = 2;
const BY_CRC: u32 = 3;
const BY_STREAM: u32 = 4;

/// Ways to damage an image, and the boot stage's report.
fn damages() -> Vec<(&'static str, Packed, u32)> {
    let damaged = |change: &dyn Fn(&mut Packed)| {
        let mut image = Packed::of(firmware::BOOTLOADER);
        change(&mut image);
        image
    };
    let ram = firmware::board().ram.size;
    vec![
        ("a bit of the magic", damaged(&|image| image.flash[image.header] ^= 1), BY_HEADER),
        ("an erased header", damaged(&|image| (0..6).for_each(|word| image.set(word, !0))), BY_HEADER),
        ("an unknown method", damaged(&|image| image.set(METHOD, 3)), BY_HEADER),
        ("more bytes than flash", damaged(&|image| image.set(STORED, 0x8000)), BY_HEADER),
        ("as many as there can be", damaged(&|image| image.set(STORED, !0)), BY_HEADER),
        ("more bytes than RAM", damaged(&|image| image.set(UNPACKED, ram - 4092)), BY_HEADER),
        ("packed told as raw", damaged(&|image| image.set(METHOD, 0)), BY_HEADER),
        ("other services", damaged(&|image| image.set(SERVICES, SERVICES_VERSION + 1)), BY_SERVICES),
        ("a bit of the CRC", damaged(&|image| image.flash[image.header + 5] ^= 0x10), BY_CRC),
        ("no CRC", damaged(&|image| image.set(CRC, 0)), BY_CRC),
        ("one byte less", damaged(&|image| image.set(STORED, image.get(STORED) - 1)), BY_CRC),
        ("a word more in RAM", damaged(&|image| image.set(UNPACKED, image.get(UNPACKED) + 4)), BY_CRC),
        ("the first bit", damaged(&|image| image.stored()[0] ^= 0x80), BY_CRC),
        // A vector that is not used here.
        ("a bit in front of it", damaged(&|image| image.flash[60] ^= 0x10), BY_CRC),
        (
            "the last bit",
            damaged(&|image| {
                let stored = image.stored();
                stored[stored.len() - 1] ^= 1;
            }),
            BY_CRC,
        ),
        (
            "a right CRC over a smaller size",
            damaged(&|image| {
                image.set(UNPACKED, image.get(UNPACKED) - 4);
                image.seal();
            }),
            BY_STREAM,
        ),
        (
            "a right CRC over a larger size",
            damaged(&|image| {
                image.set(UNPACKED, image.get(UNPACKED) + 4);
                image.seal();
            }),
            BY_STREAM,
        ),
        (
            "a right CRC over a byte behind the stream",
            damaged(&|image| {
                image.flash.push(0);
                image.set(STORED, image.get(STORED) + 1);
                image.seal();
            }),
            BY_STREAM,
        ),
        (
            "a right CRC over a stream without its end",
            damaged(&|image| {
                let len = image.flash.len();
                image.flash.truncate(len - 8);
                image.set(STORED, image.get(STORED) - 8);
                image.seal();
                image.flash.resize(len, 0xFF);
            }),
            BY_STREAM,
        ),
    ]
}

/// A device with a program continues as an application: it runs, the callgate works, and a call to
/// the bootloader leads back to the application.
#[test]
fn a_damaged_image_does_not_run_and_the_program_does() {
    let mut bench = board_with_a_program();
    for (what, image, damage) in damages() {
        load(&mut bench, &image.flash);
        bench.power_on();
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE), "{what}: the start of a program needs nothing of the image");
        assert_eq!(cell(&bench), None, "{what}");
        bench.events();
        bench.session().command(1, ProgramControl::StartBootloader).unwrap();
        bench.await_boot_up(1000);
        assert_eq!(bench.events().len(), 1, "{what}: one reset");
        assert!(!bench.is_bootloader(NODE), "{what}");
        assert_eq!(cell(&bench), Some((DAMAGED, damage)), "{what}");
        // The application reads it through the callgate.
        let crc = bench.session().read_number(Address::new(0x1F56, 1)).unwrap();
        assert_eq!(crc, firmware::blocks(firmware::APP_V1).program_crc(), "{what}");
        // It starts as before, with the cell consumed.
        bench.machine().reset_pin();
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE), "{what}");
        assert_eq!(cell(&bench), None, "{what}");
        bench.power_off();
    }
    // The entry strap does not prevent the start of a program without a working bootloader.
    let (_, image, damage) = damages().swap_remove(0);
    load(&mut bench, &image.flash);
    press(bench.machine(), true);
    bench.power_on();
    bench.await_boot_up(1000);
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(cell(&bench), Some((DAMAGED, damage)));
    press(bench.machine(), false);
    bench.power_off();
    // The image itself, for comparison.
    load(&mut bench, &Packed::of(firmware::BOOTLOADER).flash);
    bench.power_on();
    bench.await_boot_up(1000);
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    bench.await_boot_up(1000);
    assert!(bench.is_bootloader(NODE));
    assert_eq!(cell(&bench), None);
}

/// An application that crashes is started again, and the flash is not changed: there is no
/// bootloader to stay in.
#[test]
fn beside_a_damaged_image_a_program_is_not_given_up() {
    let mut bench = board_with_a_program();
    let (_, image, _) = damages().swap_remove(0);
    load(&mut bench, &image.flash);
    bench.power_on();
    bench.await_boot_up(1000);
    for reset in 1..=6 {
        bench.machine().start_watchdog(64);
        bench.run_ms(300);
        assert!(!bench.is_bootloader(NODE), "after {reset}");
        assert_eq!(cell(&bench).is_some(), reset >= 3, "after {reset}");
    }
    let parameters = |bench: &Bench| {
        let mut bytes = vec![0; firmware::board().parameters[0].size as usize * 2];
        let at = firmware::board().parameters[0].base;
        bench.world.machine(bench.device).read_memory(at, &mut bytes).unwrap();
        bytes
    };
    let before = parameters(&bench);
    bench.machine().start_watchdog(64);
    bench.run_ms(300);
    assert!(parameters(&bench) == before);
}

/// Without a program nothing can run: the chip resets again and again, which is visible at its NRST
/// pin, and the cell contains the reason.
#[test]
fn a_damaged_image_without_a_program_resets_again_and_again() {
    for (what, image, damage) in damages() {
        let mut bench = Bench::new();
        load(&mut bench, &image.flash);
        bench.power_on();
        let mut seen = 0;
        for _ in 0..80 {
            bench.run_ms(5);
            if let Some(found) = cell(&bench) {
                assert_eq!(found, (DAMAGED, damage), "{what}");
                seen += 1;
            }
        }
        // A debugger finds it there at almost any time.
        assert!(seen > 70, "{what}: {seen} times of 80");
        let resets: Vec<_> = bench.events().into_iter().map(|(_, stop)| stop).collect();
        assert!((3..=6).contains(&resets.len()), "{what}: {} resets in 400 ms", resets.len());
        assert!(resets.iter().all(|stop| *stop == Stop::Reset(ResetCause::Software)), "{what}");
        assert!(bench.records().is_empty(), "{what}: nothing on the bus");
        bench.assert_nothing_unmodelled();
    }
}

/// The boot stage's result after a power-on: the damage that it reports in the cell, or nothing if
/// the image runs.
fn outcome(bench: &mut Bench) -> Option<(u32, u32)> {
    bench.events();
    for _ in 0..200 {
        bench.world.run_for(Span::from_micros(100));
        if let Some(damage) = cell(bench).filter(|(request, _)| *request == DAMAGED) {
            return Some(damage);
        }
        // The running code may be reset at once by its own fault.
        if bench.machine().pc() >= firmware::board().ram.base || !bench.events().is_empty() {
            return None;
        }
    }
    panic!("the boot stage does not come to an end");
}

/// A stream by the description of the format: the literals "AB", a copy from this many half-words
/// before, the end.
fn one_copy(offset: usize, length: usize) -> Vec<u8> {
    fn number(bits: &mut Vec<bool>, number: usize, inverted: bool) {
        for digit in (0..number.ilog2()).rev() {
            bits.extend([false, (number >> digit & 1 == 1) != inverted]);
        }
        bits.push(true);
    }
    let mut bits = Vec::new();
    number(&mut bits, 2, false);
    let literals = bits.len();
    bits.push(true);
    number(&mut bits, (offset - 1) / 256 + 1, true);
    let lower = bits.len();
    number(&mut bits, length - 1, false);
    bits.push(true);
    number(&mut bits, 256, true);
    // A byte of bits is placed where its first bit is read.
    let mut stream = Vec::new();
    for (at, byte) in bits.chunks(8).enumerate() {
        stream.push((0..8).fold(0, |out, i| out << 1 | u8::from(byte.get(i) == Some(&true))));
        let asked_for_here = at * 8 + 1..at * 8 + 9;
        if asked_for_here.contains(&literals) {
            stream.extend(*b"AB");
        }
        if asked_for_here.contains(&lower) {
            stream.push(255 - ((offset - 1) % 256) as u8);
        }
    }
    stream
}

/// A copy may read from the flash before the header. A copy from before that is refused, and so is
/// one that continues after it, even if the stream ends correctly.
#[test]
fn a_copy_from_in_front_of_the_image() {
    let front = Packed::of(firmware::BOOTLOADER).front().to_vec();
    let end = front.len();
    let mut bench = Bench::new();
    let cases: [(usize, usize, Option<&[u8]>); 8] = [
        (1, 2, Some(b"AB")),
        (1, 5, Some(b"ABABA")),
        (2, 2, Some(&front[end - 2..])),
        (2, 3, None),
        (end / 2 + 1, 2, Some(&front[..2])),
        (end / 2 + 1, 14, Some(&front[..14])),
        (end / 2 + 2, 2, None),
        (255 * 256, 2, None),
    ];
    for (offset, length, copied) in cases {
        let stream = one_copy(offset, length);
        let unpacked = copied.map(|copied| [b"AB", copied].concat());
        assert_eq!(zx0::unpack(&front, &stream, zx0::HALF_WORDS), unpacked, "{length} from {offset}");
        let mut image = Packed::of(firmware::BOOTLOADER);
        image.flash.truncate(image.header + HEADER);
        image.flash.extend(&stream);
        image.set(STORED, stream.len() as u32);
        image.set(UNPACKED, 2 + length as u32);
        image.seal();
        load(&mut bench, &image.flash);
        bench.power_on();
        let damage = copied.is_none().then_some((DAMAGED, BY_STREAM));
        assert_eq!(outcome(&mut bench), damage, "{length} from {offset}");
        let mut found = vec![0; 2 + length];
        bench.machine().read_memory(firmware::board().ram.base, &mut found).unwrap();
        let is_there = unpacked.is_some_and(|unpacked| unpacked == found);
        // A refused stream leaves the literals, and nothing of the copy.
        assert_eq!(is_there, damage.is_none(), "{length} from {offset}");
        bench.power_off();
    }
}

/// Zeros are a number without an end, and more zeros may follow the image.
#[test]
fn a_number_without_an_end_is_damage() {
    let chip = firmware::board().chip;
    let mut image = Packed::of(firmware::BOOTLOADER);
    image.stored().fill(0);
    image.seal();
    image.flash.resize(chip.flash.size as usize, 0);
    let mut bench = Bench::new();
    load(&mut bench, &image.flash);
    bench.power_on();
    assert_eq!(outcome(&mut bench), Some((DAMAGED, BY_STREAM)));
}

/// Hostile streams with a correct CRC: whatever they contain, the boot stage only writes to the RAM
/// of the image, and always ends.
#[test]
fn no_stream_writes_outside_the_image() {
    let board = firmware::board();
    let good = Packed::of(firmware::BOOTLOADER);
    let (len, image_end) = (good.get(STORED) as usize, board.ram.base + good.get(UNPACKED));
    // Up to the stack that is left for the boot stage.
    let size = board.ram.end() - 4096 - image_end;
    let pattern: Vec<u8> = (0..size).map(|i| (i.wrapping_mul(0x9E37_79B1) >> 24) as u8).collect();
    let mut bench = Bench::new();
    let mut refused = 0;
    let mut random = 1_u32;
    let mut next = move || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        random >> 8
    };
    for round in 0..200 {
        let mut image = Packed::of(firmware::BOOTLOADER);
        let stored = image.stored();
        match round {
            // Zeros: numbers without an end. Ones: the shortest numbers.
            0 => stored.fill(0),
            1 => stored.fill(0xFF),
            2 => stored.fill(0x55),
            3 => stored.iter_mut().for_each(|byte| *byte = next() as u8),
            _ => {
                for _ in 0..1 + round % 4 {
                    stored[next() as usize % len] ^= 1 << (next() % 8);
                }
            }
        }
        image.seal();
        load(&mut bench, &image.flash);
        bench.power_on();
        bench.machine().write_ram(image_end, &pattern).unwrap();
        let damage = outcome(&mut bench);
        let mut found = vec![0; pattern.len()];
        bench.machine().read_memory(image_end, &mut found).unwrap();
        if damage.is_some() {
            assert_eq!(damage, Some((DAMAGED, BY_STREAM)), "round {round}");
            assert!(found == pattern, "round {round} has written behind the image");
            refused += 1;
        }
        // Otherwise it was a bit of a literal: the stream is complete, and another image runs.
        bench.power_off();
    }
    assert!(refused > 80, "{refused}");
}

/// The image from the linker, without a CRC: the result of `cargo build` alone and of `--unpacked`.
#[test]
fn an_image_that_is_not_packed_runs() {
    let mut image = Packed::of(firmware::BOOTLOADER_LEAST);
    let ram = image.ram.clone();
    image.flash.truncate(image.header + HEADER);
    image.flash.extend(&ram);
    for (word, value) in [(CRC, 0), (METHOD, 0), (STORED, ram.len() as u32)] {
        image.set(word, value);
    }
    assert!(image.flash.len() <= firmware::board().bootloader.size as usize);
    let mut bench = Bench::new();
    load(&mut bench, &image.flash);
    bench.power_on();
    bench.await_boot_up(100);
    assert!(bench.is_bootloader(NODE));

    // An image with a CRC is checked.
    image.seal();
    load(&mut bench, &image.flash);
    bench.power_off();
    bench.power_on();
    bench.await_boot_up(100);
    image.set(CRC, image.get(CRC) ^ 1);
    load(&mut bench, &image.flash);
    bench.power_off();
    bench.power_on();
    bench.run_ms(50);
    assert_eq!(cell(&bench), Some((DAMAGED, BY_CRC)));
}

/// A fault before the RAM image is ready has its handler in flash, by the vectors in flash: it
/// requests the bootloader and resets.
#[test]
fn a_fault_in_the_boot_stage_is_told() {
    let board = firmware::board();
    let mut image = Packed::of(firmware::BOOTLOADER).flash;
    // The word after the callgate's table is the address of the boot stage. ARMv7-M A7.7.194: udf
    // #0.
    let at = (board.callgate() - board.bootloader.base) as usize + 16;
    let stage = (words(&image[at..at + 4])[0] & !1) - board.bootloader.base;
    image[stage as usize..][..2].copy_from_slice(&[0x00, 0xDE]);
    let mut bench = Bench::new();
    load(&mut bench, &image);
    bench.power_on();
    bench.run_ms(1);
    let resets = bench.events();
    assert!(resets.len() > 3, "{resets:?}");
    assert!(resets.iter().all(|(_, stop)| *stop == Stop::Reset(ResetCause::Software)), "{resets:?}");
    // 4: a fault of the bootloader.
    assert_eq!(cell(&bench), Some((4, 0)));
}

/// This is a part of the time between "call back" and the boot-up message, during which masters
/// wait for an answer: 5 ms at most. A chip with wait states takes 1.3 cycles for an instruction
/// (see the emulator's cpu.rs).
#[test]
fn the_image_is_unpacked_within_5_ms() {
    let board = firmware::board();
    let packed = Packed::of(firmware::BOOTLOADER);
    let mut bench = Bench::new();
    bench.power_on();
    let from = bench.time();
    let (mut begun, mut done) = (None, None);
    // Measured by the first and the last decompressed word.
    let last = packed.ram.len() - 4;
    loop {
        bench.world.run_for(Span::from_micros(10));
        for (at, seen) in [(0, &mut begun), (last, &mut done)] {
            let mut word = [0; 4];
            bench.machine().read_memory(board.ram.base + at as u32, &mut word).unwrap();
            if seen.is_none() && word == packed.ram[at..at + 4] {
                *seen = Some(bench.time());
            }
        }
        let pc = bench.machine().pc();
        if board.ram.contains(pc, 2) {
            break;
        }
        assert!(bench.time() - from < Span::from_millis(100), "the bootloader does not start: {pc:#x}");
    }
    let took = done.expect("it is there before it runs") - begun.expect("and its beginning too");
    let all = bench.time() - from;
    println!(
        "{}: {} bytes unpacked to {} in {} us; reset to the first instruction in RAM: {} us",
        board.board,
        packed.get(STORED),
        packed.get(UNPACKED),
        took.0 / 1_000_000,
        all.0 / 1_000_000
    );
    assert!(took.0 / 10 * 13 <= Span::from_millis(5).0, "{} us", took.0 / 1_000_000);
    // It was really decompressed, which takes more than microseconds.
    assert!(took >= Span::from_micros(500));
}
