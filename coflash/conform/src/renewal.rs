//! Checks of the bootloader's own program number, by which it is renewed (docs/renewal.md). None of them
//! stages, tries or installs anything, and a device in the middle of a renewal is left alone.

use canopen::program::{
    FlashError, FlashStatus, ProgramControl, DEVICE_STATE, DEVICE_TYPE, FLASH_STATUS, IDENTITY,
    PROGRAM_CONTROL, PROGRAM_DATA, PROGRAM_ID, STATE_BOOTLOADER, STATE_RENEWAL,
};
use crc::{Crc, CRC_32_ISO_HDLC};
use shared_abi::ram_image::{Header, MAGIC, SERVICES_VERSION};
use shared_abi::renewal::{Origin, Progress, State};

use super::bench::{abort_of, ensure, failed, need, request, skipped, Bench, Stop};
use super::check::{Check, Step};
use super::program::{download, idle, is_bootloader, BOOTLOADER};

const CLAUSE: &str = "coboot, ADR 22";

const fn check(id: &'static str, title: &'static str, run: Step) -> Check {
    Check::new(id, title, CLAUSE, run).needs(at_rest)
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    check("REN-001", "2007h/1 is a sub-index of 1F50h, 1F51h, 1F56h and 1F57h", |b| {
        let number = number(b)?;
        for index in [PROGRAM_DATA, PROGRAM_CONTROL, PROGRAM_ID, FLASH_STATUS] {
            let highest = b.value(index, 0, 1)?;
            ensure!(highest >= number.into(), "2007h/1 is {number}, and {index:04X}h/0 is {highest}");
        }
        b.value(PROGRAM_CONTROL, number, 1)?;
        b.value(PROGRAM_ID, number, 4)?;
        idle(b, number).map(drop)
    }),
    check("REN-002", "its 1F51h reads 1: the bootloader runs", |b| {
        let number = number(b)?;
        match b.value(PROGRAM_CONTROL, number, 1)? {
            1 => Ok(()),
            other => failed(format!("1F51h/{number} is {other}")),
        }
    }),
    check("REN-003", "its 1F56h is not 0", |b| {
        let number = number(b)?;
        match b.value(PROGRAM_ID, number, 4)? {
            0 => failed(format!("1F56h/{number} is 0")),
            _ => Ok(()),
        }
    }),
    check("REN-004", "STOP is acknowledged and changes nothing", |b| is_without_effect(b, ProgramControl::Stop)),
    check("REN-005", "80h is acknowledged and changes nothing", |b| is_without_effect(b, ProgramControl::StartBootloader)),
    check("REN-006", "CLEAR is acknowledged and changes nothing", |b| is_without_effect(b, ProgramControl::Clear)),
    check("REN-007", "83h with nothing staged is acknowledged and changes nothing", |b| is_without_effect(b, ProgramControl::SetSignature)),
    check("REN-008", "84h with nothing staged is acknowledged and changes nothing", |b| is_without_effect(b, ProgramControl::ClrSignature)),
    check("REN-009", "START with nothing staged: 1F57h is NOVALPROG, and the bootloader goes on", |b| unchanged(b, |b, number| {
        command(b, number, ProgramControl::Start)?;
        expect(b, number, FlashError::NoValidProgram)
    })),
    check("REN-010", "an image without a CRC, as for the bench, is refused: FORMAT", |b| is_refused(b, false)),
    check("REN-011", "an image for another board is refused: FORMAT", |b| is_refused(b, true)),
];

/// The number of the bootloader itself.
fn number(b: &mut Bench<'_>) -> Result<u8, Stop> {
    b.value(DEVICE_STATE, STATE_BOOTLOADER, 1).map(|number| number as u8)
}

/// Skips the checks in a device without such a number, and in one that is in the middle of a renewal.
fn at_rest(b: &mut Bench<'_>) -> Result<(), Stop> {
    is_bootloader(b)?;
    let answer = b.ask(request(0x40, DEVICE_STATE, STATE_BOOTLOADER, [0; 4]))?;
    need!(
        abort_of(&answer).is_none() && number(b)? != 0,
        "2007h/1 is 0 or absent: this bootloader cannot be renewed over the bus"
    );
    match progress(b)? {
        Progress {
            state: State::None | State::Installed, origin: Origin::Home | Origin::Confirmed, ..
        } => Ok(()),
        other => skipped(format!("2007h/9 is {:02X?}: a renewal is not at its end", other.bytes())),
    }
}

/// 2007h/9.
fn progress(b: &mut Bench<'_>) -> Result<Progress, Stop> {
    let word = b.value(DEVICE_STATE, STATE_RENEWAL, 4)?;
    match Progress::from_bytes(word.to_le_bytes()) {
        Some(progress) => Ok(progress),
        None => skipped(format!("2007h/9 is {word:08X}h, which this tool does not know")),
    }
}

/// Writes a command to 1F51h of the bootloader. It is skipped where the product forbids it at present.
fn command(b: &mut Bench<'_>, number: u8, command: ProgramControl) -> Result<(), Stop> {
    let answer = b.ask(request(0x2F, PROGRAM_CONTROL, number, [command as u8, 0, 0, 0]))?;
    match abort_of(&answer) {
        None if answer[0] == 0x60 => Ok(()),
        None => failed(format!("{:02X}h in place of 60h", answer[0])),
        Some(code) => match FlashStatus::from_word(idle(b, number)?).error {
            Some(FlashError::NoAccess) => skipped("the product forbids it at present: 1F57h is NO_ACCESS"),
            _ => failed(format!("abort {code:08X}h")),
        },
    }
}

/// Expects this error in 1F57h, and takes it away again.
fn expect(b: &mut Bench<'_>, number: u8, error: FlashError) -> Result<(), Stop> {
    let status = idle(b, number)?;
    command(b, number, ProgramControl::ResetStat)?;
    match FlashStatus::from_word(status).error {
        Some(found) if found == error => Ok(()),
        _ => failed(format!("1F57h/{number} is {status:08X}h in place of {:02X}h", error.code())),
    }
}

/// Expects that a command is acknowledged, and that afterwards everything is as before.
fn is_without_effect(b: &mut Bench<'_>, which: ProgramControl) -> Result<(), Stop> {
    unchanged(b, |b, number| {
        command(b, number, which)?;
        match idle(b, number)? {
            0 => Ok(()),
            status => failed(format!("1F57h/{number} is {status:08X}h")),
        }
    })
}

/// Expects that the same bootloader runs afterwards, and that 1F56h and 2007h/9 are what they were.
fn unchanged(
    b: &mut Bench<'_>,
    step: impl FnOnce(&mut Bench<'_>, u8) -> Result<(), Stop>,
) -> Result<(), Stop> {
    let number = number(b)?;
    let state = |b: &mut Bench<'_>| Ok::<_, Stop>((b.value(PROGRAM_ID, number, 4)?, progress(b)?.bytes()));
    let before = state(b)?;
    step(b, number)?;
    match b.value(DEVICE_TYPE, 0, 4)? {
        BOOTLOADER => {}
        other => return failed(format!("1000h is {other:08X}h: the bootloader has ended")),
    }
    match state(b)? {
        after if after == before => Ok(()),
        (crc, progress) => failed(format!(
            "1F56h/{number} was {:08X}h and is {crc:08X}h; 2007h/9 was {:02X?} and is {progress:02X?}",
            before.0, before.1
        )),
    }
}

/// Expects that an image is refused by its header, before anything is erased. It is for this device in
/// everything but its board.
fn is_refused(b: &mut Bench<'_>, has_crc: bool) -> Result<(), Stop> {
    let [vendor, product] = [b.value(IDENTITY, 1, 4)?, b.value(IDENTITY, 2, 4)?];
    let image = image(vendor, product, has_crc);
    unchanged(b, |b, number| {
        command(b, number, ProgramControl::Clear)?;
        // The device may refuse it by an abort, or acknowledge it and report the error afterwards.
        download(b, number, &image)?;
        match FlashStatus::from_word(idle(b, number)?).error {
            None => failed("the image was accepted"),
            Some(error @ (FlashError::NoAccess | FlashError::NotCleared | FlashError::Secured)) => {
                command(b, number, ProgramControl::ResetStat)?;
                skipped(format!("the device takes no bootloader at present: {error}"))
            }
            _ => expect(b, number, FlashError::Format),
        }
    })
}

/// A RAM image for a board that nobody has, all 0 after its header. So a device that does not look for the
/// CRC refuses it, too, and erases nothing: the check is safe, and does not show which of the two it was.
fn image(vendor: u32, product: u32, has_crc: bool) -> Vec<u8> {
    const SIZE: u32 = 512;
    const RAM: u32 = 0x2000_0000;
    let (own, board) = (Header::SIZE, u32::MAX);
    let words =
        [MAGIC, 0, own, SIZE, RAM, RAM + SIZE, SERVICES_VERSION, 0, board, vendor, product, 0, 1, 0, 0, 0];
    let mut bytes: Vec<u8> = words.into_iter().flat_map(u32::to_le_bytes).collect();
    bytes.resize((own + SIZE) as usize, 0);
    if has_crc {
        let crc = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&bytes[Header::CRC_FROM as usize..]);
        bytes[Header::CRC as usize..Header::CRC_FROM as usize].copy_from_slice(&crc.to_le_bytes());
    }
    bytes
}
