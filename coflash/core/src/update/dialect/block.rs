//! The dialect `block` of SYS TEC and coboot: a block file, with one SDO download for each block.

use std::collections::VecDeque;
use std::time::Duration;

use canopen::program::{self, FlashError};
use canopen::{AbortCode, Address};
use shared_abi::block_file::{NUMBER_CONTROL, NUMBER_LAST};

use super::procedure::{self, Downloaded, Procedure};

use crate::advice::Advice;
use crate::device::partial_download::{partial_download, PartialDownload};
use crate::device::region::program_region;
use crate::device::{Dialect, Doing, Error, Session, Timing};
use crate::file::block_file::{Block as FileBlock, BlockFile, FRAMING};
use crate::file::checksum::Checksum;
use crate::file::convert::{blocks_of_sealed, DEFAULT_BLOCK_SIZE};
use crate::file::judge::Fault;
use crate::file::program::Program;
use crate::file::sealed::SealedFile;
use crate::update::device_after::DeviceState;
use crate::update::event::{Event, Note, Phase, RepeatReason, Warning};
use crate::update::judge::{judge, Repeats};
use crate::update::options::FlashOptions;
use crate::update::payload::Payload;
use crate::update::running::RunningUpdate;
use crate::update::{steps, trial};
use coboot_can::adapter::Delivery;

/// See the [module](self).
pub(super) struct Block;

const NOT_TOGETHER: Error = Error::NotInDialect {
    dialect: Dialect::Block,
    what: "it cannot be updated together with others, which needs a second SDO server (1201h) in its \
           bootloader and a node-ID of at most 94",
};

impl Procedure for Block {
    /// Erases, sends the blocks, compares the CRC, tries the program and releases it for autostart.
    /// With `start` off, the program is neither tried nor released. A sealed image is sent in one
    /// download, unless the user asked for blocks or the device gets it together with others; and it
    /// needs no release: its signature serves as the release.
    fn download(
        &self,
        session: &mut Session<'_>,
        file: &Payload,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Downloaded, Error> {
        let (options, crcs) = (update.options, file.crcs());
        let number = options.program;
        let mut in_group = session.join_group()?;
        if options.together && !in_group {
            return Err(NOT_TOGETHER);
        }
        let is_mixed_unseen = || matches!(file, Payload::Program(program) if is_mixed_unseen(program));
        let (file, is_sealed) = match file {
            Payload::Program(program) => (BlockFile::of(program), false),
            Payload::Bootloader(_) => return procedure::download(self, session, file, update),
            Payload::Sealed(sealed) => {
                let size = match options.blocks {
                    None if in_group => DEFAULT_BLOCK_SIZE,
                    None => return procedure::download(self, session, file, update),
                    Some(size) => size,
                };
                (cut_up(session, sealed, size, number)?, true)
            }
        };
        let joins = in_group || takes_joined(session, number)?;
        let most = if in_group { usize::MAX } else { file.size() as usize / JOINED_PARTS };
        let joined = options.joined_blocks.filter(|_| joins).map(|size| file.joined(size.min(most)));
        let file = Cut { own: &file, joined: joined.as_ref() };
        let sent = send_verified(session, file, &is_mixed_unseen, crcs, &mut in_group, update);
        if let (Err(error), true) = (&sent, in_group) {
            leave_after(session, error);
        }
        let (repeats, took) = sent?;
        if is_sealed {
            update.known.state = DeviceState::Written;
            return Ok(Downloaded { repeats, took, released: None, renewal: None });
        }
        update.known.state = DeviceState::Unreleased;
        if !options.start {
            update.report(Phase::NotReleased { program: number }.into());
            return Ok(Downloaded { repeats, took, released: Some(false), renewal: None });
        }
        if options.trial_run {
            trial::run(session, update)?;
        }
        steps::release(session, number, &mut |event| update.report(event))?;
        update.known.state = DeviceState::Released;
        Ok(Downloaded { repeats, took, released: Some(true), renewal: None })
    }
}

/// After so many blocks in a row that got through in segments only, block transfer is given up: it is
/// not a single frame that was damaged.
const HOPELESS: u32 = 3;

/// A joined block is at most this part of a program: so little more comes twice if an update is cut.
/// (The device itself keeps its progress in steps of a sixteenth.)
const JOINED_PARTS: usize = 64;

/// A file and the blocks in which it is sent.
#[derive(Clone, Copy)]
struct Cut<'f> {
    /// The file with its own blocks.
    own: &'f BlockFile<'f>,
    /// The same with larger blocks, if the device takes them.
    joined: Option<&'f BlockFile<'f>>,
}

impl<'f> Cut<'f> {
    /// The file as it is sent.
    fn file(self) -> &'f BlockFile<'f> {
        self.joined.unwrap_or(self.own)
    }

    /// Whether this block, as it is sent, has joined several of the file.
    fn has_joined(self, sent: &FileBlock<'_>) -> bool {
        let is_same = |own: &FileBlock<'_>| own.flash_address == sent.flash_address && own.data == sent.data;
        !self.own.blocks().iter().any(is_same)
    }

    /// The blocks of the file itself from `refused` on, which has joined some of them. Their numbers
    /// follow those of the blocks before it.
    fn own_from(self, refused: &FileBlock<'_>) -> Vec<FileBlock<'f>> {
        let rest = self.own.blocks().iter().filter(|block| block.number != NUMBER_CONTROL);
        let rest = rest.skip_while(|block| block.flash_address != refused.flash_address);
        let number = |block: &FileBlock<'_>, at| if block.number == NUMBER_LAST { NUMBER_LAST } else { at };
        rest.zip(refused.number..)
            .map(|(block, at)| FileBlock { number: number(block, at), ..block.clone() })
            .collect()
    }
}

/// Whether the device takes larger blocks than those of a file, or refuses them without harm: a
/// bootloader of coboot does, which the region of its program shows (2004h).
fn takes_joined(session: &mut Session<'_>, program: u8) -> Result<bool, Error> {
    Ok(program_region(session, program)?.is_some())
}

/// The blocks that carry a sealed image to the program's region of this device.
fn cut_up<'f>(
    session: &mut Session<'_>,
    sealed: &'f SealedFile,
    block_size: usize,
    program: u8,
) -> Result<BlockFile<'f>, Error> {
    let not_cut = |why: &str| Error::NoProgram {
        number: Fault::NUMBER,
        why: format!("cannot be sent in blocks: {why}"),
        advice: Advice::OneDownload,
    };
    let region = program_region(session, program)?;
    let region =
        region.ok_or_else(|| not_cut("the device does not report the start of its program (2004h)"))?;
    blocks_of_sealed(sealed, region.base, block_size).map_err(|error| not_cut(&error.to_string()))
}

impl PartialDownload {
    /// The CRC of the device, if it is the download of this file.
    fn checksum_of(self, file: &BlockFile<'_>) -> Option<Checksum> {
        let control = &file.blocks()[0];
        let is_its =
            |checksum: &Checksum| control.emit_with(*checksum).ends_with(&self.control_crc.to_le_bytes());
        [file.checksum(), file.checksum().other()].into_iter().find(is_its)
    }

    /// Whether the device has this block's data.
    fn has(self, block: &FileBlock<'_>) -> bool {
        let is_data = block.number != NUMBER_CONTROL && block.number != NUMBER_LAST;
        is_data && block.flash_address + block.data.len() as u32 <= self.end
    }
}

/// Whether a part of another version and the rest of this one may have the CRC of this one, which is all that the
/// device compares at the end. A date in block 0, whose CRC the device has kept, tells the versions apart.
fn is_mixed_unseen(program: &Program) -> bool {
    program.has_own_crc() && program.release().is_none_or(|release| release.date == 0)
}

/// Steps 4 to 9, and the comparison of the program's CRC. Goes on with a download that was cut off, unless
/// the device has refused something since; if the device's part of it proves to be wrong, everything is sent.
fn send_verified(
    session: &mut Session<'_>,
    file: Cut<'_>,
    is_mixed_unseen: &dyn Fn() -> bool,
    crcs: [u32; 2],
    in_group: &mut bool,
    update: &mut RunningUpdate<'_>,
) -> Result<(u32, Duration), Error> {
    let FlashOptions { program: number, from_start, .. } = update.options;
    let partial = if from_start { None } else { partial_download(session, number)? };
    let mut partial = partial.filter(|partial| partial.checksum_of(file.own).is_some());
    // Some bootloaders count the block that they refused last: what follows it would cost the old program.
    if partial.is_some() && session.status(number)?.error.is_some() {
        partial = None;
    }
    if partial.is_some() && is_mixed_unseen() {
        let why = "it may be of another version, which has the same CRC: the program has a CRC-32 of its own";
        update.report(Warning::BeginsAgain { why: why.to_owned() }.into());
        partial = None;
    }
    let mut all = |from, update: &mut RunningUpdate<'_>| {
        let sent = send(session, file, from, in_group, update)?;
        steps::verify(session, number, crcs, &mut |event| update.report(event))?;
        Ok(sent)
    };
    match all(partial, update) {
        Err(error @ (Error::Failed { .. } | Error::WrongCrc { .. } | Error::Refused { .. }))
            if partial.is_some() =>
        {
            update.report(Warning::BeginsAgain { why: error.to_string() }.into());
            all(None, update)
        }
        result => result,
    }
}

/// Steps 4 to 9: erases and sends all blocks, or sends those that are missing after a partial
/// download; returns the number of repetitions and the duration.
fn send(
    session: &mut Session<'_>,
    file: Cut<'_>,
    partial: Option<PartialDownload>,
    in_group: &mut bool,
    update: &mut RunningUpdate<'_>,
) -> Result<(u32, Duration), Error> {
    let number = update.options.program;
    let before = steps::crc(session, number)?;
    update.erases(before);
    if let Some(partial) = partial {
        let total = file.own.size() as usize;
        let done = partial.end.saturating_sub(file.own.start()) as usize;
        // The record of the old program goes with the first good data.
        update.known.postponed = done == 0 && before.is_some_and(|crc| crc != 0);
        update.report(Phase::GoingOn { done: done.min(total), total }.into());
    } else if let Err(error) = steps::erase(session, number, &mut |event| update.report(event)) {
        update.erase_failed(&error);
        return Err(error);
    }
    let began = session.now();
    let repeats = send_blocks(session, file, partial, in_group, update)?;
    Ok((repeats, session.now().saturating_sub(began)))
}

/// Steps 6 to 9: sends all blocks that are not in the begun download, those with data together with
/// the other devices of a group; returns the number of repetitions. If the device refuses a joined
/// block, the rest goes in the file's own blocks: they need less room, and a damaged frame costs less.
/// A device that takes block 0 with the other CRC alone gets all blocks with it.
fn send_blocks(
    session: &mut Session<'_>,
    file: Cut<'_>,
    partial: Option<PartialDownload>,
    in_group: &mut bool,
    update: &mut RunningUpdate<'_>,
) -> Result<u32, Error> {
    let begun = partial.and_then(|partial| partial.checksum_of(file.own));
    let mut checksum = begun.unwrap_or(file.own.checksum());
    let size = |blocks: &VecDeque<FileBlock<'_>>| blocks.iter().map(|block| FRAMING + block.data.len()).sum();
    let mut blocks: VecDeque<FileBlock<'_>> = file.file().blocks().iter().cloned().collect();
    let mut total = size(&blocks);
    let mut may_split = file.joined.is_some() && !*in_group;
    let (mut done, mut repeats, mut in_vain) = (0, 0, 0);
    update.report(Event::Progress { done, total });
    while let Some(block) = blocks.pop_front() {
        let bytes = file.own.emit_block(&block, checksum);
        if partial.is_some_and(|partial| partial.has(&block)) {
            done += bytes.len();
            continue;
        }
        if block.number == NUMBER_LAST && *in_group {
            session.part_from_group()?;
            *in_group = false;
        }
        let is_control = block.number == NUMBER_CONTROL;
        let one = One {
            number: block.number,
            bytes: &bytes,
            other_crc: is_control.then(|| file.own.emit_block(&block, checksum.other())),
            in_group: *in_group && !is_control,
            may_split: may_split && file.has_joined(&block),
            place: (done, total),
        };
        let form = session.transfers();
        let sent = send_block(session, one, update);
        // A device that postpones the erase starts it with the first good data: block 0 alone loses
        // nothing.
        let is_refused = sent.as_ref().is_err_and(Error::refuses_first_blocks);
        let is_split = matches!(sent, Ok(Sent { split: true, .. }));
        update.known.wrote |= block.number != 0 && !is_refused && !(is_split && block.number == 1);
        let sent = sent?;
        update.known.postponed &= block.number == NUMBER_CONTROL || sent.split;
        repeats += sent.repeats;
        if sent.by_other_crc {
            checksum = checksum.other();
            update.report(Note::OtherCrc { crc: checksum }.into());
            if std::mem::take(in_group) {
                session.part_from_group()?;
            }
        }
        in_vain = if session.transfers() == form { 0 } else { in_vain + 1 };
        if session.takes_blocks() && in_vain < HOPELESS {
            session.transfer_by(form);
        }
        if sent.split {
            may_split = false;
            blocks = file.own_from(&block).into();
            total = done + size(&blocks);
            continue;
        }
        done += bytes.len();
        update.report(Event::Progress { done, total });
    }
    Ok(repeats)
}

/// Takes a device out of its group after a failure, if it still answers: the downloads of the
/// others do not concern it any more.
fn leave_after(session: &mut Session<'_>, error: &Error) {
    session.leave_group();
    if !matches!(error, Error::Adapter(_)) {
        let (node, timing) = (session.node(), Timing { attempts: 1, ..*session.timing() });
        let mut last = session.with(node, timing);
        last.cancel_by_nobody();
        // The failure stays the result.
        let _ = last.part_from_group();
    }
}

/// A block to send.
struct One<'b> {
    number: u32,
    bytes: &'b [u8],
    /// The same with the other CRC, for block 0: a device says which CRC it has when it takes or
    /// refuses this block.
    other_crc: Option<Vec<u8>>,
    /// It goes to the devices of a group.
    in_group: bool,
    /// It has joined several blocks of the file, which can go one by one.
    may_split: bool,
    /// The bytes before it, and those of all blocks.
    place: (usize, usize),
}

/// The end of a block that the device has not refused for good.
struct Sent {
    repeats: u32,
    /// The device has taken block 0 with the other CRC.
    by_other_crc: bool,
    /// The device has not taken it as it is; the blocks that it has joined may get through.
    split: bool,
}

/// Steps 7 and 8 for one block, with repetition.
fn send_block(
    session: &mut Session<'_>,
    One { number: block, mut bytes, ref other_crc, in_group, may_split, place: (done, total) }: One<'_>,
    update: &mut RunningUpdate<'_>,
) -> Result<Sent, Error> {
    let FlashOptions { program: number, repeats: of, .. } = update.options;
    let (doing, at) = (Doing::Block(block), Address::new(program::PROGRAM_DATA, number));
    let mut repeats = Repeats { block: Some(block), count: 0, of };
    // Whether the result of an earlier transfer is unknown: its block may have arrived.
    let mut in_doubt = false;
    let (own, mut by_other_crc) = (bytes, false);
    loop {
        let delivery = if in_group { session.write_together(block, at, bytes)? } else { Delivery::Alone };
        let end = Sent { repeats: repeats.count, by_other_crc, split: false };
        let sent = match delivery {
            Delivery::Taken(devices) => {
                update.report(Note::Together { devices }.into());
                // A block that the device cannot write is reported with the next one.
                return Ok(end);
            }
            Delivery::Refused(code) => Err(Error::Refused { node: session.node(), doing, code }),
            Delivery::NoAnswer => Err(Error::NoAnswer { node: session.node(), doing }),
            Delivery::Alone | Delivery::Disturbed => {
                if delivery == Delivery::Disturbed {
                    update.report(Warning::GroupDisturbed.into());
                }
                let mut progress =
                    |part: u32| update.report(Event::Progress { done: done + part as usize, total });
                session.write(at, bytes, doing, &mut progress)
            }
        };
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        let status = session.await_idle(number, doing)?;
        // The earlier block had arrived, and the bootloader waits for the next one. If this is
        // wrong, the next block, or at the latest the program's CRC, shows it.
        if in_doubt && status.error == Some(FlashError::Sequence) {
            return Ok(end);
        }
        let judged = judge(sent, status.error.map(|error| (error, status.detail)), doing);
        let Err(failure) = judged else { return Ok(end) };
        if may_split && !in_doubt && is_too_long(&failure.error) {
            return Ok(Sent { split: true, ..end });
        }
        let why = failure.why;
        in_doubt |= why == Some(RepeatReason::NoAnswer);
        let retry = repeats.again(session, failure)?;
        if let (Some(RepeatReason::Crc), Some(other)) = (why, other_crc) {
            by_other_crc = !by_other_crc;
            bytes = if by_other_crc { other } else { own };
        }
        update.report(Event::Retry(retry));
        if repeats.count > 1 && may_split && !in_doubt {
            return Ok(Sent { repeats: repeats.count, split: true, ..end });
        }
    }
}

/// Whether the device refuses a block because of its length.
fn is_too_long(error: &Error) -> bool {
    let (Error::Refused { code, .. } | Error::Failed { code: Some(code), .. }) = error else { return false };
    matches!(*code, AbortCode::LENGTH | AbortCode::LENGTH_TOO_HIGH | AbortCode::OUT_OF_MEMORY)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::block_file;

    /// Both files have the same program, and block 0 has its CRC at offset 20.
    #[test]
    fn a_begun_download_says_the_crc_of_its_device() {
        let files = [
            (Checksum::Crc32, &include_bytes!("../../../tests/data/plain-400.blk")[..]),
            (Checksum::Crc16, include_bytes!("../../../tests/data/crc16-400.blk")),
        ];
        for (_, file) in files {
            let program = block_file::read(file).unwrap();
            let file = BlockFile::of(&program);
            for (checksum, begun) in files {
                let control_crc = u32::from_le_bytes(begun[20..24].try_into().unwrap());
                let partial = PartialDownload { control_crc, end: 0 };
                assert_eq!(partial.checksum_of(&file), Some(checksum));
            }
            assert_eq!(PartialDownload { control_crc: 1, end: 0 }.checksum_of(&file), None);
        }
    }
}
