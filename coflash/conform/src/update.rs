//! Checks that install a program. They run only if the user gives one and asks for them; the last
//! one leaves the device with it.

use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::program::{FlashError, ProgramControl, PROGRAM_DATA, PROGRAM_ID};
use canopen::Address;

use super::bench::{ensure, failed, need, request, skipped, Bench, Stop};
use super::check::{Check, Step};
use coflash_core::device::{DeviceType, Doing, Error, Session};
use coflash_core::file::block_file::BlockFile;
use coflash_core::update::{flash, steps, FlashOptions, Payload};

const PROCEDURE: &str = "L-1112, procedure in principle";
const COMMANDS: &str = "L-1112, table 2";
const OBJECTS: &str = "L-1112, table 1";
const RAM: &str = "coboot, ADR 1";
const RESUME: &str = "coboot, ADR 17";

/// The program number of the image.
const NUMBER: u8 = 1;
/// How long an erase may take: the largest F4 needs 32 s at most.
const ERASE: Duration = Duration::from_secs(60);
/// Requests that come before a call.
const LOAD: usize = 20;
/// How long the power is off.
const OFF: Duration = Duration::from_millis(500);

pub(super) const CHECKS: &[Check] = &[
    check("UPD-001", "the image is written, verified, tried, released and started", PROCEDURE, |b| {
        install(b, true)
    }),
    check("UPD-002", "1F56h/1 of the running program is the CRC of the image", OBJECTS, |b| {
        running(b)?;
        has_image(b)
    }),
    check("UPD-003", "80h to 1F51h/1 calls the running program back", COMMANDS, |b| {
        running(b)?;
        b.with(steps::call_back).map(drop)
    }),
    check("UPD-004", "the call is heard after other requests", COMMANDS, |b| {
        running(b)?;
        for _ in 0..LOAD {
            b.send_sdo(request(0x40, 0x1000, 0, [0; 4]))?;
        }
        b.with(steps::call_back).map(drop)
    }),
    check("UPD-005", "every request is answered while the device erases", RAM, |b| {
        let program = b.image()?.clone();
        in_bootloader(b)?;
        // The first CLEAR may postpone the erase to the first block.
        b.with(|session| session.command(NUMBER, ProgramControl::Clear))?;
        b.with(|session| session.await_idle(NUMBER, Doing::Command(ProgramControl::Clear)))?;
        b.with(|session| session.command(NUMBER, ProgramControl::Clear))?;
        let begun = b.now();
        while b.value(0x1F57, NUMBER, 4)? & 1 != 0 {
            ensure!(b.now() <= begun + ERASE, "it is still busy after {} s", ERASE.as_secs());
        }
        match b.value(0x1F56, NUMBER, 4)? {
            crc if program.crcs().contains(&crc) => failed("the program is still there"),
            _ => Ok(()),
        }
    }),
    check(
        "UPD-006",
        "without a program, 1F56h/1 is 0, and START says so by an abort or by 1F57h",
        COMMANDS,
        |b| {
            in_bootloader(b)?;
            b.with(|session| steps::erase_at_once(session, NUMBER))?;
            let crc = b.value(0x1F56, NUMBER, 4)?;
            ensure!(crc == 0, "1F56h/1 is {crc:08X}h");
            match b.with(|session| Ok(session.command(NUMBER, ProgramControl::Start)))? {
                Err(Error::Refused { .. }) => is_bootloader(b),
                Ok(()) => {
                    let status = b.with(|session| session.await_idle(NUMBER, Doing::Restart))?;
                    ensure!(status.error.is_some(), "START is acknowledged, and 1F57h tells no error");
                    is_bootloader(b)
                }
                Err(error) => failed(error.to_string()),
            }
        },
    ),
    check("UPD-007", "a damaged block is refused, and taken when it is right", PROCEDURE, |b| {
        let blocks = begin(b)?;
        let [_, block, ..] = &blocks[..] else { return skipped("the image has no block of data") };
        let mut damaged = block.clone();
        if let Some(last) = damaged.last_mut() {
            *last ^= 1;
        }
        match b.with(|session| Ok(write(session, 1, &damaged)))? {
            Err(Error::Refused { .. } | Error::Failed { .. }) => {}
            Ok(()) => return failed("the damaged block is taken"),
            Err(error) => return failed(error.to_string()),
        }
        b.with(|session| write(session, 1, block))
    }),
    check(
        "UPD-008",
        "after an update that the host left in the middle, the next one gets through",
        RESUME,
        |b| {
            half(b)?;
            install(b, false)
        },
    ),
    check(
        "UPD-009",
        "after a reset in the middle, no half program starts, and the next update gets through",
        PROCEDURE,
        |b| {
            half(b)?;
            b.send(&NmtCommand::ResetNode.emit(Some(b.node)))?;
            b.with(|session| session.await_boot_up(session.timing().boot).map(drop))?;
            is_bootloader(b)?;
            install(b, false)
        },
    ),
    check("UPD-010", "the same after a power cut", PROCEDURE, |b| {
        need!(b.has_power(), "no command for the power is given");
        half(b)?;
        b.power(false)?;
        b.with(|session| session.wait(OFF))?;
        b.power(true)?;
        b.with(|session| session.await_boot_up(session.timing().boot).map(drop))?;
        is_bootloader(b)?;
        install(b, false)
    }),
    check("UPD-011", "at the end the device runs the image", PROCEDURE, |b| {
        install(b, true)?;
        has_image(b)
    }),
];

const fn check(id: &'static str, title: &'static str, clause: &'static str, run: Step) -> Check {
    Check::new(id, title, clause, run).that_installs()
}

/// The whole procedure of an update, from the start or from where the device is.
fn install(b: &mut Bench<'_>, from_start: bool) -> Result<(), Stop> {
    let program = b.image()?.clone();
    let options = FlashOptions::default().from_start(from_start);
    b.with(|session| flash(session, &program, &options, &mut |_| {})).map(drop)
}

fn device_type(b: &mut Bench<'_>) -> Result<DeviceType, Stop> {
    b.with(|session| session.find())
}

fn is_bootloader(b: &mut Bench<'_>) -> Result<(), Stop> {
    match device_type(b)? {
        running if running.is_bootloader() => Ok(()),
        running => failed(format!("{running} runs in place of the bootloader")),
    }
}

fn in_bootloader(b: &mut Bench<'_>) -> Result<(), Stop> {
    b.with(|session| steps::enter_bootloader(session, &mut |_| {}))
}

/// Makes the image run, if the bootloader does.
fn running(b: &mut Bench<'_>) -> Result<(), Stop> {
    if device_type(b)?.is_bootloader() {
        install(b, true)?;
    }
    Ok(())
}

fn has_image(b: &mut Bench<'_>) -> Result<(), Stop> {
    let crcs = b.image()?.crcs();
    match b.with(|session| session.read_number(Address::new(PROGRAM_ID, NUMBER)))? {
        reported if crcs.contains(&reported) => Ok(()),
        reported => failed(format!("1F56h/1 is {reported:08X}h in place of {:08X}h", crcs[0])),
    }
}

/// CLEAR and block 0; returns all blocks, with the CRC of the file or with the other one: a product has
/// one of the two, and refuses block 0 with the other.
fn begin(b: &mut Bench<'_>) -> Result<Vec<Vec<u8>>, Stop> {
    let Payload::Program(program) = b.image()?.clone() else {
        return skipped("a sealed image has no blocks");
    };
    let file = BlockFile::of(&program);
    in_bootloader(b)?;
    b.with(|session| steps::erase(session, NUMBER, &mut |_| {}))?;
    let with = |checksum| -> Vec<Vec<u8>> {
        file.blocks().iter().map(|block| file.emit_block(block, checksum)).collect()
    };
    let blocks = with(file.checksum());
    let first = b.with(|session| Ok(write(session, 0, &blocks[0])))?;
    let Err(error) = first else { return Ok(blocks) };
    if b.with(|session| session.status(NUMBER))?.error != Some(FlashError::Crc) {
        return b.with(|_| Err(error));
    }
    let blocks = with(file.checksum().other());
    b.with(|session| write(session, 0, &blocks[0]))?;
    Ok(blocks)
}

/// Half of an update.
fn half(b: &mut Bench<'_>) -> Result<(), Stop> {
    let blocks = begin(b)?;
    for (number, block) in (0..).zip(&blocks).take(blocks.len() / 2).skip(1) {
        b.with(|session| write(session, number, block))?;
    }
    Ok(())
}

fn write(session: &mut Session<'_>, number: u32, block: &[u8]) -> Result<(), Error> {
    let doing = Doing::Block(number);
    session.write(Address::new(PROGRAM_DATA, NUMBER), block, doing, &mut |_| {})?;
    let status = session.await_idle(NUMBER, doing)?;
    match status.error {
        None => Ok(()),
        Some(error) => Err(Error::Failed { doing, error, detail: status.detail, code: None }),
    }
}
