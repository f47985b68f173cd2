//! The update of a device: the procedure of the manual (L-1112d_10, "Prinzipieller Ablauf"), steps
//! 2 to 15.
//!
//! Step 1, making the blocks, is [`convert`](crate::convert). Everything that can be judged without
//! the device was judged there.

use std::fmt;
use std::time::Duration;

use canopen::program::{self, FlashError, ProgramControl};
use canopen::{AbortCode, Address, NodeId};
use shared_abi::block_file::Control;

use crate::block_file::{Block, BlockFile};
use crate::dialect::{self, Dialect, Password};
use crate::error::{Error, Mismatch};
use crate::flying_master::{self, Asked, Mastership};
use crate::info::{absent, nameplate, Nameplate};
use crate::session::{DeviceType, Doing, Session, Timing, Transfers};

mod search;
mod trial;

/// What to do beyond the download itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlashOptions {
    /// The program: sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
    pub program: u8,
    /// How often one block is sent again after a CRC error or a broken transfer.
    pub repeats: u32,
    /// Compare the device's identity with this before anything is erased, and once more with that
    /// of the program on trial.
    pub check_target: Option<Target>,
    /// Start the program once and call it back before it is signed (steps 10 to 13).
    pub trial_run: bool,
    /// Start the program at the end (step 15).
    pub start: bool,
    /// Compare the CRC once more at the very end: the one that the program itself tells when it
    /// runs.
    pub verify: bool,
    /// The dialect that the device speaks; `None` to find it out.
    pub dialect: Option<Dialect>,
    /// What opens the device, in dialects that ask for it.
    pub unlock: Option<Password>,
    /// Whether the session can follow a device to another node-ID, which lifts need. One of several
    /// at once cannot.
    pub follow: bool,
    /// Search until the bootloader is there or the user gives up (manual, chapter 5.2, step 1):
    /// neither silence nor an application that stays ends the procedure.
    pub wait: bool,
    /// Ask for the NMT mastership around a lift's update, and give it back (CiA 814-1 clause 6.3).
    pub mastership: bool,
}

/// The device that a program is for: what 1018h/1 and 1018h/2 have to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Target {
    /// Vendor-ID.
    pub vendor_id: u32,
    /// Product code.
    pub product_code: u32,
}

impl Target {
    /// The device that a block file names in its block 0, if it names one.
    #[must_use]
    pub fn of(file: &BlockFile) -> Option<Self> {
        match *file.control() {
            Control::Plain => None,
            Control::Identity(identity) | Control::Dated { identity, .. } => {
                Some(Self { vendor_id: identity.vendor_id, product_code: identity.product_code })
            }
        }
    }
}

impl Default for FlashOptions {
    fn default() -> Self {
        Self {
            program: 1,
            repeats: 3,
            check_target: None,
            trial_run: false,
            start: true,
            verify: false,
            dialect: None,
            unlock: None,
            follow: true,
            wait: false,
            mastership: true,
        }
    }
}

/// What happens during an update. `Display` has words for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// Step 1: nothing of a bootloader yet, for this reason; it is looked for until it is there.
    Searching(String),
    /// Step 2: this is running on the device.
    Found(DeviceType),
    /// What the device tells of itself.
    Nameplate(Box<Nameplate>),
    /// The NMT mastership was taken over from this node.
    MasterTaken(NodeId),
    /// This node keeps the NMT mastership.
    MasterKept(NodeId),
    /// The NMT mastership was given back; this node has it now, if one says so.
    MasterBack(Option<NodeId>),
    /// It is the device that the file is for.
    TargetRight(Target),
    /// Step 3: the application is asked to go back to the bootloader.
    CallingBack,
    /// Step 3 has worked.
    InBootloader,
    /// The bootloader speaks this dialect.
    Speaks(Dialect),
    /// The password was right.
    Unlocked,
    /// The device goes on under another node-ID.
    Moved(NodeId),
    /// Step 4: the program is being erased.
    Erasing,
    /// Step 5: it is erased.
    Erased {
        /// How long that took.
        took: Duration,
    },
    /// Steps 6 to 9: so far the transfer has come.
    Progress {
        /// Bytes of the block file that are in the device.
        done: usize,
        /// Bytes of the block file.
        total: usize,
    },
    /// A block is sent again.
    Repeating {
        /// Its number.
        block: u32,
        /// How often it has been sent again, this time included.
        repeat: u32,
        /// How often it may be.
        of: u32,
        /// Why.
        why: RepeatReason,
    },
    /// The whole program is sent again.
    Again {
        /// How often it has been sent again, this time included.
        repeat: u32,
        /// How often it may be.
        of: u32,
        /// Why.
        why: RepeatReason,
    },
    /// The bootloader computed the CRC that the file says.
    Verified {
        /// The CRC.
        crc: u32,
    },
    /// Step 10: the program starts for a trial.
    TrialStarting,
    /// Step 13: it ran, and came back when called.
    TrialPassed(DeviceType),
    /// Step 14: the program is signed, so that it starts by itself.
    Signed,
    /// Step 15: the program starts.
    Starting,
    /// It runs.
    Started(DeviceType),
    /// After its end, the procedure's last look: the CRC is still the file's.
    VerifiedAgain {
        /// The CRC.
        crc: u32,
    },
    /// The procedure failed, and leaves the device like this.
    Left(DeviceState),
}

/// In what state a procedure that failed leaves the device, as far as it got.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceState {
    /// Nothing was changed.
    Untouched,
    /// The bootloader was called; the old program is whole.
    Called,
    /// The erasure was begun: there is no program, or an incomplete one.
    Erased,
    /// The new program is in, in a dialect without signatures.
    Written,
    /// The new program is in and right, but not signed.
    Unsigned,
    /// The new program is in and signed.
    Signed,
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Untouched => "nothing was changed in it",
            Self::Called => {
                "it may be in the bootloader; its old program is whole and starts again after a reset"
            }
            Self::Erased => {
                "it has no complete program and stays in the bootloader, ready for the next attempt"
            }
            Self::Written => "the new program is in it: it starts after a reset",
            Self::Unsigned => {
                "the new program is in it but not signed: after a reset the bootloader waits for the next attempt"
            }
            Self::Signed => "the new program is in it and signed: it starts after a reset",
        })
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Searching(why) => write!(f, "searching for the bootloader, Ctrl-C ends it ({why})"),
            Self::Found(running) => write!(f, "found {running}"),
            Self::Nameplate(plate) => write!(f, "device: {plate}"),
            Self::MasterTaken(node) => write!(f, "NMT mastership taken over from node {node}"),
            Self::MasterKept(node) => {
                write!(f, "node {node} keeps the NMT mastership: it may disturb the update")
            }
            Self::MasterBack(Some(node)) => {
                write!(f, "NMT mastership given back: node {node} is the master")
            }
            Self::MasterBack(None) => {
                f.write_str("NMT mastership given back, and nobody has said that it is the master")
            }
            Self::TargetRight(Target { vendor_id, product_code }) => {
                write!(
                    f,
                    "it is the right device: vendor-ID {vendor_id:08X}h, product code {product_code:08X}h"
                )
            }
            Self::CallingBack => f.write_str("calling the application back to the bootloader"),
            Self::InBootloader => f.write_str("the bootloader is running"),
            Self::Speaks(dialect) => write!(f, "its dialect: {dialect}"),
            Self::Unlocked => f.write_str("unlocked"),
            Self::Moved(node) => write!(f, "it answers as node {node} now"),
            Self::Erasing => f.write_str("telling it to erase the old program"),
            Self::Erased { took } if *took < PUT_OFF => {
                f.write_str("it will, with the first block that it finds good")
            }
            Self::Erased { took } => write!(f, "erased in {:.1} s", took.as_secs_f64()),
            Self::Progress { done, total } => write!(f, "{done} of {total} bytes"),
            Self::Repeating { block, repeat, of, why } => {
                write!(f, "sending block {block} again, {repeat} of {of}: {why}")
            }
            Self::Again { repeat, of, why } => {
                write!(f, "sending the program again, {repeat} of {of}: {why}")
            }
            Self::Verified { crc } => write!(f, "verified: CRC {crc:08X}h"),
            Self::TrialStarting => f.write_str("starting the program for a trial"),
            Self::TrialPassed(running) => write!(f, "the trial went well: {running} came up and came back"),
            Self::Signed => f.write_str("signed: the program starts by itself from now on"),
            Self::Starting => f.write_str("starting the program"),
            Self::Started(running) => write!(f, "running: {running}"),
            Self::VerifiedAgain { crc } => write!(f, "verified once more: CRC {crc:08X}h"),
            Self::Left(state) => write!(f, "the device: {state}"),
        }
    }
}

/// Why a block is sent again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RepeatReason {
    /// The bootloader found its CRC wrong.
    Crc,
    /// The bootloader was still busy with something else.
    Busy,
    /// The transfer was aborted by the device with a code that speaks of lost frames.
    Broken(AbortCode),
    /// The transfer got no answer.
    NoAnswer,
}

impl fmt::Display for RepeatReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Crc => f.write_str("its CRC arrived wrong"),
            Self::Busy => f.write_str("the bootloader was busy"),
            Self::Broken(code) => write!(f, "the transfer broke: {code}"),
            Self::NoAnswer => f.write_str("no answer"),
        }
    }
}

/// What an update did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Report {
    /// Bytes of the program, from its region's start on.
    pub program_size: u32,
    /// CRC of the program in the device: what 1F56h reads.
    pub program_crc: u32,
    /// Blocks that had to be sent again.
    pub repeats: u32,
    /// How long all of it took, on the bus's clock.
    pub took: Duration,
    /// How long the blocks took.
    pub transfer: Duration,
    /// How the blocks were written at the end.
    pub transfers: Transfers,
    /// What runs now, if the program was started.
    pub running: Option<DeviceType>,
    /// The dialect that the device speaks.
    pub dialect: Dialect,
}

/// How often an application is asked to go back to the bootloader. A program that was started right
/// behind its download may take the first time for a confirmation.
const CALLS: u32 = 3;
/// How long an application that was called may go on before it leaves, and is not asked again.
const LEAVES_WITHIN: Duration = Duration::from_secs(2);
/// The sub-index of 1F51h that takes the call, whichever program runs (manual, step 3). An application
/// of another maker has no other.
pub(crate) const CALL_BACK: u8 = 1;

/// Puts a program into a device: finds out what runs there, calls the bootloader, erases, sends the
/// blocks, compares the CRC, and as the options say tries, signs and starts it.
///
/// A run that was interrupted at any point can be started again at once.
///
/// # Errors
/// The first step that fails ends the procedure. Until the program is signed, the device comes up
/// in the bootloader.
pub fn flash(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    let mut state = DeviceState::Untouched;
    let mut mastership = None;
    let result = procedure(session, file, options, &mut state, &mut mastership, tell);
    if let Some(taken) = mastership {
        // What became of the update stands, whatever becomes of this.
        if let Ok(master) = flying_master::give_back(session, taken) {
            tell(Event::MasterBack(master.map(|master| master.node)));
        }
    }
    if result.is_err() {
        tell(Event::Left(state));
    }
    result
}

/// [`flash`], which keeps `state` up to date.
fn procedure(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    state: &mut DeviceState,
    mastership: &mut Option<Mastership>,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    let began = session.now();
    let number = options.program;
    let original = session.node();
    let dialect = search::reach(session, options, state, mastership, tell)?;
    let (repeats, transfer) = match dialect.content(file) {
        Some(content) if !options.trial_run => {
            let transfer_began = session.now();
            let repeats = dialect::send(session, dialect, &content, options, state, tell)?;
            let transfer = session.now().saturating_sub(transfer_began);
            *state = DeviceState::Written;
            // What 1F56h reads is a CRC in this bootloader and its like; elsewhere it is whatever
            // its maker took.
            if dialect::knows_crc(session)? {
                verify(session, number, file.program_crc(), tell)?;
            }
            (repeats, transfer)
        }
        Some(_) => {
            return Err(Error::NotInDialect { dialect, what: "there are no signatures, so no trial either" })
        }
        None => by_blocks(session, file, options, state, tell)?,
    };
    let running = if options.start {
        tell(Event::Starting);
        let running = dialect::start(session, dialect, original, number)?;
        tell(Event::Started(running));
        Some(running)
    } else {
        None
    };
    if options.verify {
        let crc = file.program_crc();
        compare_crc(session, number, crc)?;
        tell(Event::VerifiedAgain { crc });
    }
    let took = session.now().saturating_sub(began);
    let (program_size, program_crc) = (file.program_size(), file.program_crc());
    let transfers = session.transfers();
    Ok(Report { program_size, program_crc, repeats, took, transfer, transfers, running, dialect })
}

/// The way of the dialect `block`: erases, sends the blocks, compares, tries if it is asked to, and
/// signs. Gives how often a block was repeated, and how long the blocks took.
fn by_blocks(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    state: &mut DeviceState,
    tell: &mut dyn FnMut(Event),
) -> Result<(u32, Duration), Error> {
    let number = options.program;
    let before = std::mem::replace(state, DeviceState::Erased);
    erase(session, number, tell)?;
    let transfer_began = session.now();
    let sent = send_blocks(session, file, options, tell);
    if sent.as_ref().is_err_and(Error::refuses_control_block)
        && identification(session, number).is_ok_and(|crc| crc != 0)
    {
        // The device erases with the first good block, and there was none: it still has the CRC of
        // its program.
        *state = before;
    }
    let repeats = sent?;
    let transfer = session.now().saturating_sub(transfer_began);
    verify(session, number, file.program_crc(), tell)?;
    *state = DeviceState::Unsigned;
    if options.trial_run {
        trial::run(session, options, tell)?;
    }
    sign(session, number, tell)?;
    *state = DeviceState::Signed;
    Ok((repeats, transfer))
}

/// Step 3 in whatever dialect: afterwards the bootloader is running, and what it speaks is known.
fn enter(
    session: &mut Session<'_>,
    running: DeviceType,
    options: &FlashOptions,
    state: &mut DeviceState,
    mastership: &mut Option<Mastership>,
    tell: &mut dyn FnMut(Event),
) -> Result<Dialect, Error> {
    let number = options.program;
    let found = match options.dialect {
        Some(dialect) => dialect,
        None => dialect::recognise(session, running, CALL_BACK)?,
    };
    let mut dialect = found;
    match found {
        Dialect::Lift if !options.follow => {
            let what = "the bootloaders share a node-ID: update the devices one after the other";
            return Err(Error::NotInDialect { dialect, what });
        }
        Dialect::Lift => {
            tell(Event::Speaks(dialect));
            tell(Event::Nameplate(Box::new(nameplate(session)?)));
            dialect::check_lift(session, running, options.unlock)?;
            if options.mastership {
                match flying_master::ask(session)? {
                    Asked::Nobody => {}
                    Asked::Kept(master) => tell(Event::MasterKept(master.node)),
                    Asked::Taken(taken) => {
                        tell(Event::MasterTaken(taken.from.node));
                        *mastership = Some(taken);
                    }
                }
            }
            dialect::enter_lift(session, options.unlock, &mut |event| {
                if event == Event::CallingBack {
                    *state = DeviceState::Called;
                }
                tell(event);
            })?;
            return Ok(dialect);
        }
        _ if running.is_bootloader() => {}
        Dialect::Raw | Dialect::Hex => {
            *state = DeviceState::Called;
            dialect::stop_program(session, number, tell)?;
        }
        Dialect::Block | Dialect::EsAcademy => {
            *state = DeviceState::Called;
            tell(Event::CallingBack);
            let running = call_back(session)?;
            tell(Event::InBootloader);
            if options.dialect.is_none() {
                dialect = Dialect::of_bootloader(running, session.node()).unwrap_or(found);
            }
        }
    }
    tell(Event::Speaks(dialect));
    Ok(dialect)
}

/// Compares the device's identity with that of the file's target. Bootloader and application have
/// the same one.
///
/// # Errors
/// [`Error::WrongTarget`], and what a [read](Session::read) has.
pub fn check_target(session: &mut Session<'_>, target: Target) -> Result<(), Error> {
    let wanted = [(1, target.vendor_id), (2, target.product_code)];
    for (sub, file) in wanted {
        let device = session.read_number(Address::new(program::IDENTITY, sub))?;
        if device != file {
            let what = if sub == 1 { Mismatch::VendorId } else { Mismatch::ProductCode };
            return Err(Error::WrongTarget { node: session.node(), what, device, file });
        }
    }
    Ok(())
}

/// Steps 2 and 3: afterwards the bootloader is running.
///
/// # Errors
/// [`Error::NoAnswer`] where nothing answers, [`Error::NoBootloader`] where the application does
/// not go back.
pub fn enter_bootloader(session: &mut Session<'_>, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    let running = find(session)?;
    tell(Event::Found(running));
    if running.is_bootloader() {
        return Ok(());
    }
    tell(Event::CallingBack);
    call_back(session)?;
    tell(Event::InBootloader);
    Ok(())
}

/// Step 2: what is running, or [`Error::NoAnswer`]. A device that was just reset misses a few
/// requests, so that the question is repeated for as long as a restart may take.
///
/// # Errors
/// [`Error::NoAnswer`], and what a [read](Session::read) has.
pub fn find(session: &mut Session<'_>) -> Result<DeviceType, Error> {
    let deadline = session.now() + session.timing().boot;
    loop {
        if let Some(running) = session.device_type()? {
            return Ok(running);
        }
        if session.now() >= deadline {
            let at = Address::new(program::DEVICE_TYPE, 0);
            return Err(Error::NoAnswer { node: session.node(), doing: Doing::Read(at) });
        }
        let pause = session.timing().poll_first;
        session.await_boot_up(pause)?;
    }
}

/// Steps 3 and 12, 13: asks the application to go back to the bootloader and waits until it has.
///
/// Gives what the bootloader says it is.
///
/// # Errors
/// [`Error::NoBootloader`].
pub fn call_back(session: &mut Session<'_>) -> Result<DeviceType, Error> {
    let node = session.node();
    let mut seen = None;
    for call in 1..=CALLS {
        match session.command(CALL_BACK, ProgramControl::StartBootloader) {
            // A device that resets at once may not get its answer out.
            Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
            Err(Error::Refused { code, .. }) => {
                let running = session.device_type()?;
                return Err(Error::NoBootloader { node, running, code: Some(code) });
            }
            Err(error) => return Err(error),
        }
        let timing = *session.timing();
        // An application that goes on as before has taken the first call for a confirmation.
        let first = Timing { boot: timing.boot.min(LEAVES_WITHIN), ..timing };
        seen = settle(
            &mut session.with(node, if call == 1 { first } else { timing }),
            DeviceType::is_bootloader,
        )?;
        if call == 1 && seen.is_none() {
            // It restarts.
            seen = settle(session, DeviceType::is_bootloader)?;
        }
        if let Some(running) = seen.filter(|running| running.is_bootloader()) {
            return Ok(running);
        }
    }
    Err(Error::NoBootloader { node, running: seen, code: None })
}

/// Waits for a restarting device, [`Timing::boot`](crate::session::Timing::boot) at most, until
/// what it runs is what is `wanted`; gives what answered last.
fn settle(
    session: &mut Session<'_>,
    wanted: impl Fn(DeviceType) -> bool,
) -> Result<Option<DeviceType>, Error> {
    let deadline = session.now() + session.timing().boot;
    loop {
        // The boot-up message says when to look; without it (it may get lost) a look now and then
        // does.
        let pause = session.timing().sdo;
        session.await_boot_up(pause)?;
        let seen = session.device_type()?;
        if seen.is_some_and(&wanted) || session.now() >= deadline {
            return Ok(seen);
        }
    }
}

/// Steps 4 and 5: erases the program.
///
/// # Errors
/// [`Error::Failed`] with what 1F57h says, [`Error::Busy`], [`Error::NoAnswer`].
pub fn erase(session: &mut Session<'_>, number: u8, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    tell(Event::Erasing);
    let began = session.now();
    execute(session, number, ProgramControl::Clear)?;
    tell(Event::Erased { took: session.now().saturating_sub(began) });
    Ok(())
}

/// Steps 4 and 5 on a device that may have no 1F57h to tell how it goes, and may answer when it has
/// erased.
pub(crate) fn clear_and_wait(
    session: &mut Session<'_>,
    number: u8,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    match session.status(number) {
        Err(Error::Refused { code, .. }) if absent(code) => {}
        Err(error @ Error::Refused { .. }) => return Err(error),
        _ => return erase(session, number, tell),
    }
    tell(Event::Erasing);
    let began = session.now();
    let node = session.node();
    let patient = Timing { sdo: session.timing().command, ..*session.timing() };
    session.with(node, patient).command(number, ProgramControl::Clear)?;
    tell(Event::Erased { took: session.now().saturating_sub(began) });
    Ok(())
}

/// An erasure that is over sooner than this was put off, or had little to do. Erasing a sector of
/// flash takes longer.
const PUT_OFF: Duration = Duration::from_millis(100);

/// Gets rid of the program, without another one in its place. A bootloader that puts the erasure
/// off until the first block comes (figure 12 of the manual) is told a second time, which there
/// means at once; elsewhere that erases what is erased already.
///
/// # Errors
/// As [`erase`].
pub fn erase_at_once(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    let began = session.now();
    execute(session, number, ProgramControl::Clear)?;
    if session.now().saturating_sub(began) < PUT_OFF {
        execute(session, number, ProgramControl::Clear)?;
    }
    Ok(())
}

/// Step 14: signs the program, so that it starts by itself.
///
/// # Errors
/// As [`erase`].
pub fn sign(session: &mut Session<'_>, number: u8, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    execute(session, number, ProgramControl::SetSignature)?;
    tell(Event::Signed);
    Ok(())
}

/// Takes the signature away: the program does not start by itself any more.
///
/// # Errors
/// As [`erase`].
pub fn unsign(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    execute(session, number, ProgramControl::ClrSignature)
}

/// Sets 1F57h back to "no error".
///
/// # Errors
/// As [`erase`].
pub fn reset_status(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    execute(session, number, ProgramControl::ResetStat)
}

/// Gives a command that may be repeated, and waits until it is carried out.
fn execute(session: &mut Session<'_>, number: u8, command: ProgramControl) -> Result<(), Error> {
    let doing = Doing::Command(command);
    let mut attempt = 1;
    loop {
        match session.command(number, command) {
            Ok(()) => break,
            Err(Error::NoAnswer { .. } | Error::Protocol { .. }) if attempt < session.timing().attempts => {
                attempt += 1;
                // The command may have arrived, and the device may be silent because it carries it
                // out.
                session.await_idle(number, doing)?;
            }
            Err(Error::Refused { code, .. }) => return Err(explain(session, number, doing, code)),
            Err(error) => return Err(error),
        }
    }
    let status = session.await_idle(number, doing)?;
    match status.error {
        None => Ok(()),
        Some(error) => Err(Error::Failed { doing, error, detail: status.detail, code: None }),
    }
}

/// What an SDO abort means: 1F57h tells it best, if it tells something.
fn explain(session: &mut Session<'_>, number: u8, doing: Doing, code: AbortCode) -> Error {
    match session.status(number) {
        Ok(status) => match status.error {
            Some(error) => Error::Failed { doing, error, detail: status.detail, code: Some(code) },
            None => Error::Refused { node: session.node(), doing, code },
        },
        Err(_) => Error::Refused { node: session.node(), doing, code },
    }
}

/// Steps 6 to 9: all blocks; gives how many had to be repeated.
fn send_blocks(
    session: &mut Session<'_>,
    file: &BlockFile,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<u32, Error> {
    let blocks: Vec<(&Block, Vec<u8>)> =
        file.blocks().iter().map(|block| (block, block.emit_with(file.checksum()))).collect();
    let total = blocks.iter().map(|(_, bytes)| bytes.len()).sum();
    let mut done = 0;
    let mut repeats = 0;
    tell(Event::Progress { done, total });
    for (block, bytes) in &blocks {
        repeats += send_block(session, block.number, bytes, options, &mut |event| match event {
            Event::Progress { done: part, .. } => tell(Event::Progress { done: done + part, total }),
            event => tell(event),
        })?;
        done += bytes.len();
        tell(Event::Progress { done, total });
    }
    Ok(repeats)
}

/// Steps 7 and 8 for one block, with repetition; gives how often it was repeated.
fn send_block(
    session: &mut Session<'_>,
    block: u32,
    bytes: &[u8],
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<u32, Error> {
    let doing = Doing::Block(block);
    let at = Address::new(program::PROGRAM_DATA, options.program);
    let mut repeat = 0;
    // Whether a transfer ended without our knowing how: its block may have arrived.
    let mut in_doubt = false;
    loop {
        let mut progress = |part: u32| tell(Event::Progress { done: part as usize, total: bytes.len() });
        let sent = session.write(at, bytes, doing, &mut progress);
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        let status = session.await_idle(options.program, doing)?;
        // It had arrived, and the bootloader waits for the next one. Should that not be so, the
        // next one and at the latest the program's CRC will tell.
        if in_doubt && status.error == Some(FlashError::Sequence) {
            return Ok(repeat);
        }
        let (why, error) = match judge(sent, status.error.map(|error| (error, status.detail)), doing) {
            Judgement::Good => return Ok(repeat),
            Judgement::Bad { why, error } => (why, error),
        };
        in_doubt |= why == Some(RepeatReason::NoAnswer);
        match why {
            Some(why) if repeat < options.repeats => {
                repeat += 1;
                // A device, or an adapter, that cannot cope with block transfers may cope with
                // segments.
                if repeat > 1 && matches!(why, RepeatReason::Broken(_) | RepeatReason::NoAnswer) {
                    session.transfer_by(Transfers::Segments);
                }
                tell(Event::Repeating { block, repeat, of: options.repeats, why });
            }
            _ => return Err(error),
        }
    }
}

/// What came of a download.
pub(crate) enum Judgement {
    /// It arrived, and the device is content.
    Good,
    /// It did not, or it is not.
    Bad {
        /// Why sending it again may help, if it may.
        why: Option<RepeatReason>,
        /// What it is called if it is not sent again.
        error: Error,
    },
}

/// Judges a download by its outcome and by what the device's status says, with its detail.
pub(crate) fn judge(sent: Result<(), Error>, status: Option<(FlashError, u16)>, doing: Doing) -> Judgement {
    let (why, error) = match (sent, status) {
        (Ok(()), None) => return Judgement::Good,
        (sent, Some((error, detail))) => {
            let code = match sent {
                Err(Error::Refused { code, .. }) => Some(code),
                _ => None,
            };
            (repeatable(error), Error::Failed { doing, error, detail, code })
        }
        (Err(error @ Error::Refused { code, .. }), None) => {
            let broken =
                matches!(code, AbortCode::TOGGLE | AbortCode::TIMEOUT | AbortCode::COMMAND | AbortCode::CRC);
            (broken.then_some(RepeatReason::Broken(code)), error)
        }
        (Err(error), None) => (Some(RepeatReason::NoAnswer), error),
    };
    Judgement::Bad { why, error }
}

/// Whether sending a block again can help against this error.
fn repeatable(error: FlashError) -> Option<RepeatReason> {
    match error {
        FlashError::Crc => Some(RepeatReason::Crc),
        FlashError::Busy => Some(RepeatReason::Busy),
        _ => None,
    }
}

/// Compares the CRC that the bootloader computed with the file's (manual, chapter 5.2, step 4).
///
/// # Errors
/// [`Error::WrongCrc`].
pub fn verify(
    session: &mut Session<'_>,
    number: u8,
    crc: u32,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    compare_crc(session, number, crc)?;
    tell(Event::Verified { crc });
    Ok(())
}

/// 1F56h: the CRC over the program that is in the device, 0 for none.
fn identification(session: &mut Session<'_>, number: u8) -> Result<u32, Error> {
    session.read_number(Address::new(program::PROGRAM_ID, number))
}

fn compare_crc(session: &mut Session<'_>, number: u8, crc: u32) -> Result<(), Error> {
    let device = identification(session, number)?;
    if device != crc {
        return Err(Error::WrongCrc { device, file: crc });
    }
    Ok(())
}

/// Steps 10, 11 and 15: starts the program and waits until it answers; gives what it says it is.
///
/// # Errors
/// [`Error::StartFailed`].
pub fn start(session: &mut Session<'_>, number: u8) -> Result<DeviceType, Error> {
    let node = session.node();
    let failed = |running, status| Error::StartFailed { node, running, status };
    match session.command(number, ProgramControl::Start) {
        // A device that resets at once may not get its answer out.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
        Err(Error::Refused { .. }) => {
            let running = session.device_type()?;
            return Err(failed(running, session.status(number).ok()));
        }
        Err(error) => return Err(error),
    }
    match settle(session, |running| !running.is_bootloader())? {
        Some(running) if !running.is_bootloader() => Ok(running),
        Some(running) => Err(failed(Some(running), session.status(number).ok())),
        None => Err(failed(None, None)),
    }
}

/// Waits for an application, `time` at most; gives what it says it is.
pub(crate) fn await_application(
    session: &mut Session<'_>,
    time: Duration,
) -> Result<Option<DeviceType>, Error> {
    let (node, timing) = (session.node(), Timing { boot: time, ..*session.timing() });
    let seen = settle(&mut session.with(node, timing), |running| !running.is_bootloader())?;
    Ok(seen.filter(|running| !running.is_bootloader()))
}
