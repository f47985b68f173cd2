//! The file for production: a device from the line starts its first program without CAN, and is an ordinary one.

use boot_core::store::Key;
use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, HEARTBEAT, NODE};
use coboot_tests::factory::{board, bootloader, first, image, journal, latest, program};
use coboot_tests::firmware;
use coflash_core::device::option_bytes::OptionBytes;
use coflash_core::file::factory::{Bootloader, Fault};
use coflash_core::file::judge::Fault as Judged;
use coflash_core::file::nameplate::nameplate;
use coflash_core::file::sealed::provision::protected_sectors;
use coflash_core::file::{convert, elf, ihex, program_of, read, Firmware, Format, Image, Target};
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::{Machine, Options};
use emulator::time::Time;
use kit::rig::crc32;
use shared_abi::journal::{self as codec, slot};
use shared_abi::label::Label;
use shared_abi::layout::Layout;
use shared_abi::nameplate::Nameplate;

/// "CBNV", the tag of a journal's header.
const HEADER: u32 = 0x564E_4243;
/// The emergency of the bootloader (CiA 301: 80h and the node-ID).
const EMERGENCY: u32 = 0x80 + NODE as u32;

/// The built bootloader with version 1.
fn version_1() -> Image {
    let boot = bootloader(firmware::BOOTLOADER);
    boot.join(&first(&boot, firmware::APP_V1))
}

/// Checks 1F56h, 1F57h and 2005h of a running device: they are those of a program that was downloaded.
fn says(bench: &mut Bench, application: &str, version: u32, is_bootloader: bool) {
    let numbers = [0x1F56, 0x1F57, 0x2005]
        .map(|index| bench.session().read_number(Address::new(index, 1)).expect("the object is there"));
    assert_eq!(numbers, [crc32(&firmware::raw(application)), 0, version]);
    assert_eq!(bench.is_bootloader(NODE), is_bootloader);
}

#[test]
fn the_first_power_on_starts_the_program_and_no_frame_asks_for_it() {
    let mut bench = board(&version_1());
    bench.power_on();
    bench.await_program(100);
    bench.run_ms(50);
    let others = bench.frames_since(Time(0));
    let others: Vec<_> = others.iter().filter(|(_, id, _)| ![HEARTBEAT, EMERGENCY].contains(id)).collect();
    assert!(others.is_empty(), "{others:?}");
    says(&mut bench, firmware::APP_V1, 1, false);
    bench.call_back();
    says(&mut bench, firmware::APP_V1, 1, true);
    // It has returned, so it is a confirmed one, and an ordinary update follows.
    flash(&mut bench.session(), firmware::blocks(firmware::APP_V2), &FlashOptions::default(), &mut |_| {})
        .unwrap();
    bench.restart();
    says(&mut bench, firmware::APP_V2, 2, false);
    bench.assert_nothing_unmodelled();
}

/// Header and record of a device that got the same program over CAN.
#[test]
fn the_records_are_those_that_the_device_writes() {
    let mut updated = Bench::new().switched_on();
    let options = FlashOptions::default().trial_run(false);
    flash(&mut updated.session(), firmware::blocks(firmware::APP_V1), &options, &mut |_| {}).unwrap();
    let made = board(&version_1());
    let of_tool = journal(&made);
    let of_device = journal(&updated);
    let tags = [HEADER, Key::program(1).0];
    assert_eq!(of_tool, latest(&of_device, &tags));
    let flash = firmware::board().programs[0];
    let bytes = [&updated, &made].map(|bench| bench.memory(flash.base, flash.size as usize));
    assert!(bytes[0] == bytes[1], "the flash of the program");
}

#[test]
fn node_id_and_bit_rate_are_those_of_the_file() {
    let rate = BitRate::K500;
    let boot = bootloader(firmware::BOOTLOADER).with_node(9, rate as u8).unwrap();
    let mut bench = board(&boot.join(&first(&boot, firmware::APP_V1)));
    bench.set_host_bit_rate(500_000);
    bench.power_on();
    bench.await_program_of(9, 100);
    assert!(!bench.is_bootloader(9));
}

/// HEX, ELF and raw image bring the same flash, by the emulator's own readers.
#[test]
fn every_format_has_the_same_flash() {
    let file = version_1();
    let board = firmware::board();
    let mut machines = [(); 3].map(|()| Machine::new(board.chip, Options::default()).unwrap());
    machines[0].load_hex(&ihex::emit(&file)).unwrap();
    let loaded = machines[1].load(&elf::emit(&file, 0x0800_00CD)).unwrap();
    assert_eq!(loaded.entry, Some(0x0800_00CD));
    machines[2].load_bin(board.bootloader.base, &file.filled()).unwrap();
    let [hex, elf, raw] = machines;
    assert!(hex.flash() == elf.flash() && hex.flash() == raw.flash());
    assert!(hex.flash()[..0x1000] == firmware_of(&file)[..0x1000]);
}

/// The flash of a board that a probe has written the file to.
fn firmware_of(file: &Image) -> Vec<u8> {
    board(file).machine().flash().to_vec()
}

/// A device that comes back to the line: in its other region is a journal with a later sequence number.
#[test]
fn an_older_journal_does_not_count() {
    let [_, other] = firmware::board().parameters;
    let mut bench = Bench::new();
    let old = [
        slot(HEADER, codec::header(7), crc32),
        slot(Key::NODE.0, codec::node(9, BitRate::K125 as u8), crc32),
    ];
    let bytes: Vec<u8> = old.into_iter().flatten().flat_map(u32::to_le_bytes).collect();
    bench.machine().load_bin(other.base, &bytes).unwrap();
    bench.soil_programs();
    program(&mut bench, &version_1());
    bench.power_on();
    bench.await_program(100);
    says(&mut bench, firmware::APP_V1, 1, false);
}

/// The text for OpenOCD does what RM0090 section 3.6.2 says, and the device with these option bytes takes an update.
#[test]
fn the_option_bytes_protect_the_bootloader_and_nothing_else() {
    let file = version_1();
    let protect = protected_sectors(&file, firmware::board());
    assert!(protect & 1 == 1 && protect.count_ones() <= 2, "{protect:b}");
    let text = OptionBytes::of_product(3, protect).commands("STM32F407VG");
    let openocd = text.lines().find(|line| line.starts_with("openocd")).unwrap();
    let numbers = |line: &str| {
        let words = line.split([' ', ';']).filter_map(|word| word.strip_prefix("0x"));
        words.map(|word| u32::from_str_radix(word, 16).unwrap()).collect::<Vec<_>>()
    };
    let words = numbers(openocd);
    let [key, key_1, key_again, key_2, register, value, register_again, begun] = words[..] else {
        panic!("{openocd}")
    };
    assert_eq!([key, key_1, key_again, key_2], [0x4002_3C08, 0x0819_2A3B, 0x4002_3C08, 0x4C5D_6E7F]);
    assert_eq!([register, register_again, begun], [0x4002_3C14, 0x4002_3C14, value | 1 << 1]);
    let by_probe_rs = text.lines().filter(|line| line.starts_with("probe-rs")).flat_map(numbers);
    assert!(by_probe_rs.eq(words.iter().copied()));
    assert!(text.contains("-ob BOR_LEV=0 nWRP0=0"), "{text}");
    let mut bench = board(&file);
    bench.machine().set_option_bytes(value);
    bench.power_on();
    bench.await_program(100);
    bench.call_back();
    let state = bench.session().read_number(Address::new(0x2007, 6)).unwrap();
    assert_eq!((OptionBytes(state).protected(), OptionBytes(state).warnings()), (protect, vec![]));
    flash(&mut bench.session(), firmware::blocks(firmware::APP_V2), &FlashOptions::default(), &mut |_| {})
        .unwrap();
    says(&mut bench, firmware::APP_V2, 2, false);
}

/// A product whose identity is in the one-time programmable bytes.
#[test]
fn a_nameplate_is_the_identity_of_the_file() {
    let plate = nameplate(&Nameplate::new(0x123, 0x5EA1_0007, 3, 99), 0, true);
    let refused = bootloader(firmware::BOOTLOADER).with_nameplate(&plate).map(drop);
    assert_eq!(refused, Err(Fault::UnreadNameplate));
    let of_oem = || bootloader(firmware::BOOTLOADER_SWITCHES);
    let boot = of_oem().with_nameplate(&plate).unwrap();
    assert_eq!((of_oem().identity(), boot.identity()), (None, Some((0x123, 0x5EA1_0007))));
    let with = |product_code| {
        let labelled =
            firmware::with_label(firmware::raw(firmware::APP_V1), &Label::new(0x123, product_code, 1));
        boot.plain(1, &firmware::blocks_of_raw(&labelled))
    };
    let file = boot.join(&with(0x5EA1_0007).unwrap());
    let mut machine = Machine::new(firmware::board().chip, Options::default()).unwrap();
    machine.load(&elf::emit(&file, 0)).unwrap();
    let mut bytes = [0; 4];
    machine.read_memory(0x1FFF_7800, &mut bytes).unwrap();
    assert_eq!(bytes, *b"CBNP");
    let program = Target { vendor_id: 0x123, product_code: 8 };
    let device = (0x123, 0x5EA1_0007);
    assert_eq!(with(8).map(drop), Err(Fault::Identity { program, device }));
    assert_eq!(of_oem().with_nameplate(&file).map(drop), Err(Fault::NoNameplate));
    let node = |id| of_oem().with_node(id, BitRate::K125 as u8).map(drop);
    assert_eq!((node(2), node(1)), (Ok(()), Err(Fault::Node(2, 100))));
}

#[test]
fn what_does_not_fit_is_refused() {
    let board = firmware::board();
    let boot = bootloader(firmware::BOOTLOADER);
    let elsewhere: &Layout = Box::leak(Box::new(Layout { board: "another", ..*board }));
    let of = |image: Image, layout| Bootloader::new(image, layout).map(drop);
    assert_eq!(of(image(firmware::BOOTLOADER), elsewhere), Err(Fault::OtherBoard("another")));
    assert!(matches!(of(image(firmware::APP_V1), board), Err(Fault::Bootloader(_))), "a program");
    assert!(matches!(of(version_1(), board), Err(Fault::Bootloader(_))), "a file that is done");
    // One byte of the RAM image differs, the last one of the bootloader's.
    let mut elf = firmware::elf(firmware::BOOTLOADER);
    let whole = image(firmware::BOOTLOADER);
    let (_, tail) = whole.segments().last().unwrap();
    let tail = &tail[tail.len() - 64..];
    let at = elf.windows(64).rposition(|bytes| bytes == tail).unwrap();
    elf[at + 63] ^= 1;
    let Firmware::Image(damaged) = read(&elf, None, None).unwrap() else { panic!("an ELF") };
    assert!(matches!(of(damaged, board), Err(Fault::RamImage(_))));

    let raw = firmware::raw(firmware::APP_V1);
    let mut at_random = raw.clone();
    at_random[4..8].copy_from_slice(&(board.programs[0].end() + 1).to_le_bytes());
    let refused = boot.plain(1, &firmware::blocks_of_raw(&at_random)).map(drop);
    assert!(matches!(refused, Err(Fault::Program(Judged::ResetVector { .. }))), "{refused:?}");
    let count = board.programs.len();
    let refused = boot.plain(9, &firmware::blocks(firmware::APP_V1)).map(drop);
    assert_eq!(refused, Err(Fault::NoProgram(9, count)));
    let size = board.programs[0].size as usize + 4;
    let long = firmware::made_up(size, |_| 0);
    let long = read(&long, Some(Format::Raw), Some(board.programs[0].base)).unwrap();
    let long = program_of(long, &convert::Options::default()).unwrap().program;
    assert!(matches!(boot.plain(1, &long).map(drop), Err(Fault::Elsewhere(..))), "past the end");
    let other = firmware::with_label(raw, &Label::new(0, 1, 1));
    let refused = boot.plain(1, &firmware::blocks_of_raw(&other)).map(drop);
    assert!(matches!(refused, Err(Fault::Identity { .. })), "{refused:?}");
}
