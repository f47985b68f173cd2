//! Files for production (`coflash seal factory`) of the built firmware, and a probe that writes them.

use coflash_core::file::factory::{Bootloader, First};
use coflash_core::file::{read, Firmware, Image};
use shared_abi::layout::Layout;

use crate::bench::Bench;
use crate::firmware;

/// A built image.
///
/// # Panics
/// If it was not built.
pub fn image(name: &str) -> Image {
    match read(&firmware::elf(name), None, None).expect("an ELF of ours") {
        Firmware::Image(image) => image,
        Firmware::Blocks(_) => panic!("an ELF is no block file"),
    }
}

/// A built bootloader of the tested board.
///
/// # Panics
/// If it was not built.
pub fn bootloader(name: &str) -> Bootloader {
    Bootloader::new(image(name), firmware::board()).expect("a bootloader of ours")
}

/// A built application as the first program.
///
/// # Panics
/// If it was not built, or is not for the bootloader.
pub fn first(bootloader: &Bootloader, application: &str) -> First {
    bootloader.plain(1, &firmware::blocks(application)).expect("an application for this board")
}

/// Writes a file into the flash as a probe does: it erases the sectors in which the file has bytes, and no others.
///
/// # Panics
/// If the file has bytes outside the flash.
pub fn program(bench: &mut Bench, file: &Image) {
    let Layout { chip, .. } = firmware::board();
    let mut cells = bench.machine().flash_cells();
    let at = |address: u32| (address - chip.flash.base) as usize;
    for sector in chip.sectors() {
        let first = at(sector.region.base);
        if file.part(sector.region.into()).is_some() {
            cells.bytes[first..first + sector.region.size as usize].fill(0xFF);
        }
    }
    for (address, bytes) in file.segments() {
        cells.bytes[at(address)..][..bytes.len()].copy_from_slice(&bytes);
    }
    bench.machine().set_flash_cells(&cells);
}

/// A board with nothing but this file in its flash, without power.
///
/// # Panics
/// As [`program`].
pub fn board(file: &Image) -> Bench {
    let mut bench = Bench::new();
    let mut cells = bench.machine().flash_cells();
    cells.bytes.fill(0xFF);
    bench.machine().set_flash_cells(&cells);
    program(&mut bench, file);
    bench
}

/// The slots of the journal that have something in them, in the order of their addresses.
pub fn journal(bench: &Bench) -> Vec<Vec<u8>> {
    let slots = firmware::board().parameters.map(|region| bench.memory(region.base, region.size as usize));
    let slots = slots.iter().flat_map(|region| region.chunks_exact(28));
    slots.filter(|slot| slot.iter().any(|byte| *byte != 0xFF)).map(<[u8]>::to_vec).collect()
}

/// The latest slot of each of these tags.
///
/// # Panics
/// If one of them is missing.
pub fn latest(journal: &[Vec<u8>], tags: &[u32]) -> Vec<Vec<u8>> {
    let of = |tag: &u32| journal.iter().rfind(|slot| slot[..4] == tag.to_le_bytes()).cloned();
    tags.iter().map(|tag| of(tag).unwrap_or_else(|| panic!("no slot {tag:08X}h: {journal:02X?}"))).collect()
}
