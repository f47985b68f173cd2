//! The images from `cargo xtask build`.

use std::path::{Path, PathBuf};
use std::{env, fs};

use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::{read, Firmware, Format};
use coflash_core::file::Program;
use coflash_core::update::JOINED_BLOCKS;
use object::read::elf::ElfFile32;
use object::{Endianness, Object, ObjectSection};
use shared_abi::label::{self, Label};
use shared_abi::layout::{self, Layout};

/// The images, with their names in `cargo xtask build`.
pub const BOOTLOADER: &str = "bootloader.elf";
/// The bootloader without any optional feature.
pub const BOOTLOADER_LEAST: &str = "bootloader-least.elf";
/// The bootloader with CRC-16 in blocks and programs.
pub const BOOTLOADER_CRC_16: &str = "bootloader-crc-16.elf";
/// The bootloader that reads node-ID and bit rate from switches, with its own COB-IDs.
pub const BOOTLOADER_SWITCHES: &str = "bootloader-switches.elf";
/// The bootloader that starts programs with a watchdog of a second.
pub const BOOTLOADER_WATCHDOG: &str = "bootloader-watchdog.elf";
/// The bootloader that two resets by the NRST pin keep, and that starts the loader in the ROM.
pub const BOOTLOADER_WAYS_IN: &str = "bootloader-ways-in.elf";
/// The bootloader whose parameters are in an EEPROM.
pub const BOOTLOADER_EEPROM: &str = "bootloader-eeprom.elf";
/// The bootloaders for masters that expect Paulus, and for masters that expect the boot loader of
/// ESAcademy.
pub const BOOTLOADER_PAULUS: &str = "bootloader-paulus.elf";
/// See [`BOOTLOADER_PAULUS`].
pub const BOOTLOADER_ESACADEMY: &str = "bootloader-esacademy.elf";
/// The bootloader of a lift; its second program is a set of parameters.
pub const BOOTLOADER_LIFT: &str = "bootloader-lift.elf";
/// The application of a lift, in two versions.
pub const APP_LIFT: [&str; 2] = ["app-lift.elf", "app-lift-v2.elf"];
/// The bootloader with a text log for a debug probe.
pub const BOOTLOADER_LOG_RTT: &str = "bootloader-log-rtt.elf";
/// The same with a `defmt` log.
pub const BOOTLOADER_LOG_DEFMT: &str = "bootloader-log-defmt.elf";
/// The same with a text log on the board's UART.
pub const BOOTLOADER_LOG_UART: &str = "bootloader-log-uart.elf";
/// The bootloader that accepts sealed images, and only these after it has keys.
pub const BOOTLOADER_SEALED: &str = "bootloader-sealed.elf";
/// The same for applications that write flash: it cannot be renewed.
pub const BOOTLOADER_SEALED_WRITES_FLASH: &str = "bootloader-sealed-writes-flash.elf";
/// The same with a text log for a debug probe, and with the debugger interface.
pub const BOOTLOADER_SEALED_LOG_RTT: &str = "bootloader-sealed-log-rtt.elf";
/// See [`BOOTLOADER_SEALED_LOG_RTT`].
pub const BOOTLOADER_SEALED_DEBUGGER: &str = "bootloader-sealed-debugger.elf";
/// The bootloader with the debugger interface, which no product has.
pub const BOOTLOADER_DEBUGGER: &str = "bootloader-debugger.elf";
/// The bootloader with CAN over the board's UART.
pub const BOOTLOADER_VIRTUAL_CAN: &str = "bootloader-virtual-can.elf";
/// The application for that bootloader.
pub const APP_VIRTUAL_CAN: &str = "app-virtual-can.elf";
/// Version 1 of the application.
pub const APP_V1: &str = "app-v1.elf";
/// Version 2 of the application.
pub const APP_V2: &str = "app-v2.elf";
/// The template with what only tests need: 2000h, the way back, and 2001h, the state of the program.
pub const APP_TEST: &str = "app-test.elf";
/// Version 1 of the application with the debugger interface, which no product has.
pub const APP_DEBUGGER: &str = "app-debugger.elf";
/// Version 2 of the application for the region of the second program, on a board that has one.
pub const PROGRAM_2: &str = "app-program-2.elf";
/// The application in C, and the same for the region of the second program.
pub const APP_C: &str = "app-c.elf";
/// See [`APP_C`].
pub const APP_C_PROGRAM_2: &str = "app-c-program-2.elf";
/// The application in C with object 2100h, which calls the callgate by hand, and the same one at the
/// place of the second program.
pub const APP_C_PROBE: &str = "app-c-probe.elf";
/// See [`APP_C_PROBE`].
pub const APP_C_PROBE_PROGRAM_2: &str = "app-c-probe-program-2.elf";

/// The address of the first symbol of an image with such a name.
///
/// # Panics
/// If there is none.
pub fn symbol(image: &str, is: impl Fn(&str) -> bool) -> u32 {
    use object::{Object as _, ObjectSymbol as _};
    let elf = elf(image);
    let file = object::File::parse(&*elf).expect("an ELF");
    let mut symbols = file.symbols();
    let symbol = symbols.find(|symbol| symbol.name().is_ok_and(&is)).expect("the symbol");
    symbol.address() as u32 & !1
}

/// The name of an image for another board than the tested one.
pub fn of_board(board: &str, image: &str) -> String {
    format!("../{board}/{image}")
}

/// The board of the images: `COBOOT_BOARD`, or the board with the compiled board file.
///
/// # Panics
/// If the board does not exist.
pub fn board() -> &'static Layout {
    match env::var("COBOOT_BOARD") {
        Ok(name) => {
            layout::by_name(&name).unwrap_or_else(|| panic!("COBOOT_BOARD: no board is called {name:?}"))
        }
        Err(_) => bsp::LAYOUT,
    }
}

/// Where the first program begins in the flash of the board, in bytes from the start of the flash.
pub fn program_offset() -> usize {
    (board().programs[0].base - board().chip.flash.base) as usize
}

/// The folder of the images: `COBOOT_FIRMWARE_DIR`, or the default folder of `cargo xtask build`.
pub fn dir() -> PathBuf {
    env::var_os("COBOOT_FIRMWARE_DIR").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../target/firmware").join(board().board),
        PathBuf::from,
    )
}

/// An application's image as the blocks for the device.
///
/// # Panics
/// If it was not built, or does not match the board.
pub fn blocks(name: &str) -> Program {
    let _ = elf(name);
    blocks_of_file(&dir().join(name))
}

/// An application in blocks of 4 KiB, as a group of devices gets it.
///
/// # Panics
/// As [`blocks`].
pub fn large_blocks(name: &str) -> Program {
    let _ = elf(name);
    blocks_with(&dir().join(name), Options::default().block_size(JOINED_BLOCKS))
}

/// The same for an ELF file anywhere.
///
/// # Panics
/// If it is none, or does not fit the board.
pub fn blocks_of_file(elf: &Path) -> Program {
    blocks_with(elf, Options::default())
}

fn blocks_with(elf: &Path, options: Options) -> Program {
    let image = coflash_core::file::read::load(elf, None, None).expect("an ELF of ours");
    let options = options.region(Region::Strict(board().programs[0].into()));
    program_of(image, &options).expect("it lies in the program's flash").program
}

/// A raw image of program 1 as the blocks for the device.
///
/// # Panics
/// If it does not fit.
pub fn blocks_of_raw(bytes: &[u8]) -> Program {
    let place = board().programs[0];
    let image = read(bytes, Some(Format::Raw), Some(place.base)).expect("bytes at an address");
    let options = Options::default().region(Region::Strict(place.into()));
    program_of(image, &options).expect("it fits").program
}

/// A branch to itself (ARMv7-M A7.7.12).
pub const HERE: [u8; 2] = 0xE7FE_u16.to_le_bytes();

/// A program without effects, a vector table and a loop; with the address of the loop.
pub fn endless_loop() -> (u32, Program) {
    let mut image = made_up(0x400, |_| 0);
    image[0x200..0x202].copy_from_slice(&HERE);
    (board().programs[0].base + 0x200, blocks_of_raw(&image))
}

/// An application as a raw image: its bytes from the start of the first program; gaps are FFh.
///
/// # Panics
/// If it was not built, or does not begin there.
pub fn raw(name: &str) -> Vec<u8> {
    raw_from(board().programs[0].base, name)
}

/// The same from the start of any program.
///
/// # Panics
/// As [`raw`].
pub fn raw_from(base: u32, name: &str) -> Vec<u8> {
    let Firmware::Image(image) = read(&elf(name), None, None).expect("an ELF of ours") else {
        panic!("an ELF is no block file");
    };
    let mut bytes = Vec::new();
    for (address, data) in image.segments() {
        let at = (address - base) as usize;
        bytes.resize(bytes.len().max(at + data.len()), 0xFF);
        bytes[at..at + data.len()].copy_from_slice(&data);
    }
    bytes
}

/// A raw image with another label.
///
/// # Panics
/// If the image is shorter than that.
pub fn with_label(mut image: Vec<u8>, label: &Label) -> Vec<u8> {
    image[label::OFFSET as usize..][..label::SIZE].copy_from_slice(&label.emit());
    image
}

/// The bytes of an image.
///
/// # Panics
/// If it was not built; the message gives the command.
pub fn elf(name: &str) -> Vec<u8> {
    let folder = dir();
    fs::read(folder.join(name)).unwrap_or_else(|error| {
        let board = folder.file_name().unwrap_or_default().display();
        panic!(
            "{}: {error}. Build the firmware first: `cargo xtask build --all --board {board}`.",
            folder.join(name).display()
        )
    })
}

/// Bytes that a bootloader accepts as the start of program 1: initial stack pointer in RAM, reset
/// vector inside, the other bytes are `byte`.
pub fn made_up(len: usize, byte: impl Fn(usize) -> u8) -> Vec<u8> {
    let (ram, program) = (board().ram, board().programs[0]);
    let mut bytes: Vec<u8> = (0..len).map(byte).collect();
    bytes[..4].copy_from_slice(&ram.end().to_le_bytes());
    bytes[4..8].copy_from_slice(&(program.base + 0x201).to_le_bytes());
    bytes
}

/// A section of an ELF file: its address and its contents.
///
/// # Panics
/// If it is not an ELF file, or has no such section.
pub fn section(elf: &[u8], name: &str) -> (u32, Vec<u8>) {
    let file = ElfFile32::<Endianness>::parse(elf).expect("an ELF file");
    let section = file.section_by_name(name).unwrap_or_else(|| panic!("no section {name}"));
    (section.address() as u32, section.data().expect("its bytes").to_vec())
}
