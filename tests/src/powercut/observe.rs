//! What a board does after the power returns, with its flash in some state.

use canopen::program::{ProgramControl, DEVICE_STATE, STATE_VERSIONS};
use canopen::Address;
use coflash_core::device::{Doing, Session};
use emulator::machine::{Cells, ResetCause, Stop};
use shared_abi::geometry::Region;

use boot_core::crc32;
use boot_core::store::{Journal, Parameters as _};

use super::story::{program_flash, Observation, Outcome, Story, BOOT_MS};
use crate::bench::Bench;
use crate::{firmware, renewal};
use kit::model::ModelFlash;

const VERSION: Address = Address::new(0x100A, 0);

/// The power returns; returns what the board does then.
///
/// # Errors
/// What it must not do: be silent, run something else than a whole program, or touch what the
/// emulator does not model.
pub fn switched_on(story: &Story, bench: &mut Bench, cells: &Cells) -> Result<Observation, String> {
    records_are_true(cells)?;
    bench.power_off();
    bench.machine().set_flash_cells(cells);
    observe(story, bench)
}

/// The same with the flash that the board has; its power is off.
///
/// # Errors
/// As [`switched_on`].
pub fn observe(story: &Story, bench: &mut Bench) -> Result<Observation, String> {
    bench.events();
    let from = bench.time();
    bench.power_on();
    bench.run_ms(BOOT_MS);
    // A program that was never confirmed starts after a reset, at the end of the rescue window.
    let resets = bench.events();
    if !matches!(resets[..], [] | [(_, Stop::Reset(ResetCause::Software))]) {
        return Err(format!("it starts with {resets:?}"));
    }
    let boot_ups = bench.frames_since(from);
    let boot_up = boot_ups.iter().rev().find(|(_, id, data)| (0x701..=0x77F).contains(id) && *data == [0]);
    let Some(node) = boot_up.map(|(_, id, _)| (id & 0x7F) as u8) else {
        return Err(format!("no boot-up within {BOOT_MS} ms"));
    };
    let told = bench.session_with(node).device_type().map_err(|error| format!("no answer: {error}"))?;
    let outcome = match told {
        None => return Err("it does not say what it is".into()),
        Some(kind) if kind.is_bootloader() => Outcome::Bootloader,
        Some(_) => {
            let version = bench.session_with(node).read_text(VERSION).map_err(|error| error.to_string())?;
            let (outcome, whole) = match version.as_str() {
                "1.0.0" => (Outcome::Old, &story.programs[0]),
                "2.0.0" => (Outcome::New, &story.programs[1]),
                _ => return Err(format!("it runs version {version:?}")),
            };
            if program_flash(bench.machine().flash()).get(..whole.len()) != Some(whole) {
                return Err(format!("version {version} runs, and is not whole"));
            }
            outcome
        }
    };
    let bootloader = story.from.bootloader.map(|_| called_back(bench, node)).transpose()?;
    let events = bench.events();
    if !events.is_empty() {
        return Err(format!("{} answers after {events:?}", outcome.name()));
    }
    let reports = bench.machine().reports();
    if !reports.is_empty() {
        return Err(format!("the firmware touched what the emulator does not model: {reports:?}"));
    }
    Ok(Observation { outcome, node, bootloader })
}

/// Calls the bootloader, which mends what a cut has left of a renewal; returns its version.
fn called_back(bench: &mut Bench, node: u8) -> Result<u32, String> {
    bench
        .session_with(node)
        .command(1, ProgramControl::StartBootloader)
        .map_err(|error| error.to_string())?;
    bench.run_ms(BOOT_MS);
    let events = bench.events();
    if !matches!(events[..], [(_, Stop::Reset(ResetCause::Software))]) {
        return Err(format!("the call back ends in {events:?}"));
    }
    let mut session = bench.session_with(node);
    let read = |session: &mut Session<'_>| {
        session.await_idle(renewal::number(), Doing::Installation)?;
        session.read(Address::new(DEVICE_STATE, STATE_VERSIONS))
    };
    let versions = read(&mut session).map_err(|error| format!("the bootloader does not answer: {error}"))?;
    let version = versions.first_chunk().ok_or("it has no version")?;
    Ok(u32::from_le_bytes(*version))
}

/// No program has a false record, not even one that the CRC at the start would reject.
fn records_are_true(cells: &Cells) -> Result<(), String> {
    let board = firmware::board();
    let mut flash = ModelFlash::new(board.chip);
    flash.poke(board.chip.flash.base, &cells.bytes);
    let journal = Journal::open(&flash, board.parameters);
    for (number, region) in (1..).zip(board.programs) {
        let Some(record) = journal.program(&flash, number) else { continue };
        let program = Region::new(region.base, record.size.min(region.size));
        let from = program.base - board.chip.flash.base;
        let between = cells.unstable.range(from..from + program.size).next();
        if crc32(flash.cells(program)) != record.crc || between.is_some() {
            return Err(format!("program {number} has a record, and is not what it says"));
        }
    }
    Ok(())
}
