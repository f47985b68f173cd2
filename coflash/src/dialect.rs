//! Dialects: what different bootloaders make of the same objects, and how to tell them apart.
//!
//! | dialect | the program goes as | before | afterwards |
//! |---|---|---|---|
//! | [`Block`](Dialect::Block) | block file, an SDO download for each block | CLEAR | signature, START |
//! | [`Raw`](Dialect::Raw) | image from the program's start, one download | CLEAR | START |
//! | [`Hex`](Dialect::Hex) | Intel HEX text, one download | CLEAR | START |
//! | [`EsAcademy`](Dialect::EsAcademy) | Intel HEX text, one download | password in 7F50h, which erases | it runs by itself |
//! | [`Lift`](Dialect::Lift) | image, one download, at node-ID 126 | password in 6005h, in application and bootloader | "reset program" |
//!
//! The steps that all have in common are in [`flash`](crate::flash).

use std::fmt;
use std::time::Duration;

use canopen::nmt::parse_state_message;
use canopen::program::{
    self, FlashError, ProgramControl, ProgramState, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE, LIFT_NODE_ID,
};
use canopen::{AbortCode, Address, NodeId};

use crate::block_file::BlockFile;
use crate::error::Error;
use crate::flash::{
    await_application, call_back, clear_and_wait, find, judge, DeviceState, Event, FlashOptions, Judgement,
    RepeatReason, CALL_BACK,
};
use crate::info::{absent, optional};
use crate::session::{DeviceType, Doing, Session, Timing, Transfers};

/// The password of 7F50h as ESAcademy gives it: "INIT".
pub const ESACADEMY_PASSWORD: u32 = 0x494E_4954;

/// "Lock/unlock parameters: Firmware update" (CiA 814-1 clause 6.3). Where it has no sub-index 1,
/// it is a plain variable.
const UNLOCK: [Address; 2] =
    [Address::new(program::UNLOCK, program::UNLOCK_FIRMWARE), Address::new(program::UNLOCK, 0)];

/// The program of a lift; what else 1F50h holds are data, which are not started (CiA 814-1 clause
/// 6.4).
const LIFT_PROGRAM: u8 = 1;
/// How long a lift bootloader may take to come up (CiA 814-1 clause 6.3).
const LIFT_WAIT: Duration = Duration::from_secs(10);
/// How often it is asked for meanwhile: a device that listens for the bit rate needs somebody who
/// talks.
const LIFT_PAUSE: Duration = Duration::from_millis(125);
/// How long it takes to hear a heartbeat: they come once a second in most networks.
const HEARTBEAT: Duration = Duration::from_millis(1200);
/// A device that takes the whole program at once may erase behind any of its segments: 2 s at
/// worst, and some more.
const SLOW_SEGMENT: Duration = Duration::from_secs(5);
/// How long a program that starts by itself may take until its bootloader is told to.
const BY_ITSELF: Duration = Duration::from_secs(1);
/// Generic error and manufacturer-specific error of 1001h: a flash operation went wrong
/// (ESAcademy).
const ERROR_BITS: u32 = 0x81;

/// Which dialect a bootloader speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dialect {
    /// SYS TEC, and coboot's own.
    Block,
    /// CiA 302-3, an image.
    Raw,
    /// CiA 302-3, Intel HEX.
    Hex,
    /// CiA 417, as CiA 814-1 describes it.
    Lift,
    /// ESAcademy's minimal boot loader.
    EsAcademy,
}

impl Dialect {
    /// Its name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Block => "block",
            Self::Raw => "raw",
            Self::Hex => "hex",
            Self::Lift => "lift",
            Self::EsAcademy => "esacademy",
        }
    }

    /// What a bootloader with this device type speaks, at this node-ID; `None` for what is an
    /// application or unknown.
    #[must_use]
    pub fn of_bootloader(running: DeviceType, node: NodeId) -> Option<Self> {
        match running.0 {
            program::BOOTLOADER_DEVICE_TYPE => Some(Self::Block),
            LIFT_DEVICE_TYPE => Some(Self::Lift),
            ESACADEMY_DEVICE_TYPE if node.get() == LIFT_NODE_ID => Some(Self::Lift),
            ESACADEMY_DEVICE_TYPE => Some(Self::EsAcademy),
            _ => None,
        }
    }

    /// The whole program as one SDO download takes it; `None` where it takes blocks.
    #[must_use]
    pub fn content(self, file: &BlockFile) -> Option<Vec<u8>> {
        match self {
            Self::Block => None,
            Self::Raw | Self::Lift => Some(file.flash_image()),
            Self::Hex | Self::EsAcademy => Some(intel_hex(file).into_bytes()),
        }
    }
}

impl fmt::Display for Dialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Block => "block (block files, as SYS TEC has it)",
            Self::Raw => "raw (CiA 302-3, an image)",
            Self::Hex => "hex (CiA 302-3, Intel HEX)",
            Self::Lift => "lift (CiA 417)",
            Self::EsAcademy => "esacademy (Intel HEX behind a password)",
        })
    }
}

/// The longest password.
const PASSWORD_MAX: usize = 64;

/// What opens a device for an update. `Debug` does not show it.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Password {
    bytes: [u8; PASSWORD_MAX],
    len: usize,
}

impl Password {
    /// From its text; `None` for an empty one, and for one of more than 64 bytes.
    #[must_use]
    pub fn new(text: &str) -> Option<Self> {
        let mut bytes = [0; PASSWORD_MAX];
        let len = text.len();
        bytes.get_mut(..len)?.copy_from_slice(text.as_bytes());
        (len > 0).then_some(Self { bytes, len })
    }

    /// The text, for 6005h.
    fn text(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// The number, for 7F50h: `0x494E4954`, or its four characters, the highest first, `INIT`.
    #[must_use]
    pub fn number(&self) -> Option<u32> {
        let text = std::str::from_utf8(self.text()).ok()?;
        match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
            Some(digits) if digits.bytes().all(|digit| digit.is_ascii_hexdigit()) => {
                u32::from_str_radix(digits, 16).ok()
            }
            _ => self.text().try_into().ok().map(u32::from_be_bytes),
        }
    }
}

impl fmt::Debug for Password {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Password(…)")
    }
}

/// Finds out which dialect a device speaks of which this is running. A bootloader tells it by its
/// device type. Of an application it is known for lifts; of the others, whether they belong to a
/// bootloader with the status of 1F57h, which tells more when it runs.
///
/// # Errors
/// What a [read](Session::read) has.
pub fn recognise(session: &mut Session<'_>, running: DeviceType, number: u8) -> Result<Dialect, Error> {
    if let Some(dialect) = Dialect::of_bootloader(running, session.node()) {
        return Ok(dialect);
    }
    if has(session, UNLOCK[0])? || has(session, UNLOCK[1])? {
        return Ok(Dialect::Lift);
    }
    if has(session, Address::new(program::FLASH_STATUS, number))? {
        return Ok(Dialect::Block);
    }
    Ok(Dialect::Raw)
}

/// Whether there is such an object, readable or not.
fn has(session: &mut Session<'_>, at: Address) -> Result<bool, Error> {
    match session.read(at) {
        Ok(_) => Ok(true),
        Err(Error::Refused { code: AbortCode::NO_OBJECT | AbortCode::NO_SUB_INDEX, .. }) => Ok(false),
        Err(Error::Refused { .. }) => Ok(true),
        Err(error) => Err(error),
    }
}

/// The file as Intel HEX text: 16 bytes in a record, extended linear addresses (Intel, revision A,
/// 1988).
#[must_use]
pub fn intel_hex(file: &BlockFile) -> String {
    const RECORD: usize = 16;
    let mut text = String::new();
    let mut record = |offset: u16, kind: u8, data: &[u8]| {
        let [high, low] = offset.to_be_bytes();
        let mut bytes = vec![data.len() as u8, high, low, kind];
        bytes.extend_from_slice(data);
        bytes.push(bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)).wrapping_neg());
        text.push(':');
        text.extend(bytes.iter().map(|byte| format!("{byte:02X}")));
        text.push_str("\r\n");
    };
    let mut upper = None;
    for (start, data) in file.image().segments() {
        let mut at = start;
        let mut rest = &data[..];
        while !rest.is_empty() {
            if upper != Some(at >> 16) {
                upper = Some(at >> 16);
                record(0, 4, &((at >> 16) as u16).to_be_bytes());
            }
            // Up to an address that 16 divides, so that no record crosses 64 KiB.
            let len = rest.len().min(RECORD - at as usize % RECORD);
            record(at as u16, 0, &rest[..len]);
            at = at.wrapping_add(len as u32);
            rest = &rest[len..];
        }
    }
    record(0, 1, &[]);
    text
}

// --- the way into the bootloader
// -------------------------------------------------------------------------------------

/// Asks an application of a device that knows CiA 302-3 alone for its bootloader: STOP; a
/// bootloader is what answers then. One that refuses may know coboot's and SYS TEC's call.
///
/// # Errors
/// [`Error::NoBootloader`].
pub(crate) fn stop_program(
    session: &mut Session<'_>,
    number: u8,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    const RUNNING: u32 = ProgramState::Running as u32;
    let control = |number| Address::new(program::PROGRAM_CONTROL, number);
    // The one that runs may be another one than the one that is to be written.
    let mut running = None;
    for number in [number, CALL_BACK] {
        if optional(session.read_number(control(number)))? == Some(RUNNING) {
            running = Some(number);
            break;
        }
    }
    let Some(running) = running else {
        // Its bootloader runs already, or nobody can tell.
        return Ok(());
    };
    let at = control(running);
    tell(Event::CallingBack);
    match session.command(running, ProgramControl::Stop) {
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
        Err(Error::Refused { .. }) => {
            call_back(session)?;
            tell(Event::InBootloader);
            return Ok(());
        }
        Err(error) => return Err(error),
    }
    let deadline = session.now() + session.timing().boot;
    loop {
        match session.read_number(at) {
            Ok(RUNNING) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
            Ok(_) => break,
            Err(Error::Refused { code, .. }) if absent(code) => break,
            Err(error) => return Err(error),
        }
        if session.now() >= deadline {
            let (node, running) = (session.node(), session.device_type()?);
            return Err(Error::NoBootloader { node, running, code: None });
        }
        let pause = session.timing().sdo;
        session.await_boot_up(pause)?;
    }
    tell(Event::InBootloader);
    Ok(())
}

/// Brings a lift device into its bootloader and unlocks it there (CiA 814-1 clause 6.3). From then
/// on the session is with node 126. [`check_lift`] comes before.
///
/// # Errors
/// [`Error::NoPassword`], [`Error::NoBootloader`], and [`Error::Refused`] for a wrong password.
pub fn enter_lift(
    session: &mut Session<'_>,
    password: Option<Password>,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    let node = session.node();
    let password = password.ok_or(Error::NoPassword { node })?;
    let lift = lift_node();
    if node != lift {
        unlock(session, password)?;
        tell(Event::Unlocked);
        tell(Event::CallingBack);
        reset_program(session, LIFT_PROGRAM)?;
        session.talk_to(lift);
        await_lift(session)?;
        tell(Event::Moved(lift));
        tell(Event::InBootloader);
    }
    unlock(session, password)?;
    tell(Event::Unlocked);
    Ok(())
}

/// Looks whether a lift device can be updated, before anything is done to it: a password is there,
/// and no other device has node-ID 126, be it one that only sends heartbeats (CiA 814-1 clause 6.3).
///
/// # Errors
/// [`Error::NoPassword`], [`Error::Occupied`], [`Error::NoBootloader`].
pub fn check_lift(
    session: &mut Session<'_>,
    running: DeviceType,
    password: Option<Password>,
) -> Result<(), Error> {
    let (node, lift) = (session.node(), lift_node());
    if password.is_none() {
        return Err(Error::NoPassword { node });
    }
    if node == lift {
        return if running.is_bootloader() {
            Ok(())
        } else {
            Err(Error::NoBootloader { node, running: Some(running), code: None })
        };
    }
    let mut look = session.with(lift, brief(session.timing()));
    let there = look.device_type()?.is_some()
        || look.hears_the_bus()
            && look.observe_until(HEARTBEAT, &mut |frame| {
                parse_state_message(frame).is_some_and(|(node, _)| node == lift)
            })?;
    if there {
        return Err(Error::Occupied { node: lift });
    }
    Ok(())
}

/// Node 126.
fn lift_node() -> NodeId {
    const { NodeId::new(LIFT_NODE_ID).expect("1 to 127") }
}

/// Asks once, and not for long.
fn brief(timing: &Timing) -> Timing {
    Timing { sdo: LIFT_PAUSE.min(timing.sdo), attempts: 1, ..*timing }
}

/// Waits until a lift bootloader answers.
fn await_lift(session: &mut Session<'_>) -> Result<(), Error> {
    let deadline = session.now() + LIFT_WAIT.max(session.timing().boot);
    let timing = brief(session.timing());
    loop {
        // A boot-up message says when to look; it may get lost.
        session.await_boot_up(LIFT_PAUSE)?;
        let node = session.node();
        let running = session.with(node, timing).device_type()?;
        if running.is_some_and(DeviceType::is_bootloader) {
            return Ok(());
        }
        if session.now() >= deadline {
            return Err(Error::NoBootloader { node: session.node(), running, code: None });
        }
    }
}

/// Writes the password of a lift.
fn unlock(session: &mut Session<'_>, password: Password) -> Result<(), Error> {
    let [first, second] = UNLOCK;
    match session.write(first, password.text(), Doing::Unlock, &mut |_| {}) {
        Err(Error::Refused { code: AbortCode::NO_SUB_INDEX, .. }) => {
            session.write(second, password.text(), Doing::Unlock, &mut |_| {})
        }
        result => result,
    }
}

/// "Reset program" (2 of 1F51h); where there is no such object, NMT reset node.
fn reset_program(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    let at = Address::new(program::PROGRAM_CONTROL, number);
    match session.write(at, &[ProgramControl::ResetStat as u8], Doing::Restart, &mut |_| {}) {
        Err(Error::Refused { code, .. }) if absent(code) => session.reset_node(),
        // A device that resets at once may not get its answer out.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

// --- the program
// -----------------------------------------------------------------------------------------------------

/// Sends the program as one SDO download, with what each attempt begins with; gives how often it
/// was repeated.
///
/// # Errors
/// As [`flash`](crate::flash::flash).
pub(crate) fn send(
    session: &mut Session<'_>,
    dialect: Dialect,
    content: &[u8],
    options: &FlashOptions,
    state: &mut DeviceState,
    tell: &mut dyn FnMut(Event),
) -> Result<u32, Error> {
    let at = Address::new(program::PROGRAM_DATA, options.program);
    let total = content.len();
    let mut repeat = 0;
    loop {
        let before = std::mem::replace(state, DeviceState::Erased);
        if let Err(error) = prepare(session, dialect, options, tell) {
            // A password that is refused erases nothing.
            if matches!(error, Error::Refused { doing: Doing::Unlock, .. } | Error::NotInDialect { .. }) {
                *state = before;
            }
            return Err(error);
        }
        tell(Event::Progress { done: 0, total });
        let slow = Timing { sdo: SLOW_SEGMENT.max(session.timing().sdo), ..*session.timing() };
        let node = session.node();
        let mut long = session.with(node, slow);
        let mut progress = |part: u32| tell(Event::Progress { done: part as usize, total });
        let sent = long.write(at, content, Doing::Program, &mut progress);
        let transfers = long.transfers();
        session.transfer_by(transfers);
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        let status = status(session, dialect, options.program)?;
        let (why, error) = match judge(sent, status, Doing::Program) {
            Judgement::Good => return Ok(repeat),
            Judgement::Bad { why, error } => (why, error),
        };
        match why {
            Some(why) if repeat < options.repeats => {
                repeat += 1;
                if repeat > 1 && matches!(why, RepeatReason::Broken(_) | RepeatReason::NoAnswer) {
                    session.transfer_by(Transfers::Segments);
                }
                tell(Event::Again { repeat, of: options.repeats, why });
            }
            _ => return Err(error),
        }
    }
}

/// What comes before each attempt.
fn prepare(
    session: &mut Session<'_>,
    dialect: Dialect,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    match dialect {
        // Unlocked already; what is there is overwritten.
        Dialect::Block | Dialect::Lift => Ok(()),
        Dialect::Raw | Dialect::Hex => clear_and_wait(session, options.program, tell),
        Dialect::EsAcademy => {
            let node = session.node();
            let password = match options.unlock {
                None => ESACADEMY_PASSWORD,
                Some(password) => password.number().ok_or(Error::NotInDialect {
                    dialect,
                    what: "the password is a number of 32 bits: 0x and up to 8 digits, or 4 characters",
                })?,
            };
            let at = Address::new(program::ENABLE_FLASH, options.program);
            // It erases before it answers.
            let patient = Timing { sdo: session.timing().command, ..*session.timing() };
            let written =
                session.with(node, patient).write(at, &password.to_le_bytes(), Doing::Unlock, &mut |_| {});
            match written {
                Ok(()) => tell(Event::Unlocked),
                // It is optional; without it the download alone has to do.
                Err(Error::Refused { code: AbortCode::NO_OBJECT, .. }) => {}
                Err(error) => return Err(error),
            }
            Ok(())
        }
    }
}

/// What the device says of the download: by 1F57h if it has that, otherwise as far as the dialect
/// tells.
fn status(
    session: &mut Session<'_>,
    dialect: Dialect,
    number: u8,
) -> Result<Option<(FlashError, u16)>, Error> {
    let at = Address::new(program::FLASH_STATUS, number);
    match session.read(at) {
        Err(Error::Refused { code, .. }) if absent(code) => {}
        // What took the whole program may restart at once.
        Err(Error::NoAnswer { .. }) if dialect == Dialect::EsAcademy => return Ok(None),
        Ok(_) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {
            let status = session.await_idle(number, Doing::Program)?;
            return Ok(status.error.map(|error| (error, status.detail)));
        }
        Err(error) => return Err(error),
    }
    if dialect != Dialect::EsAcademy {
        return Ok(None);
    }
    // Bits 0 and 7 tell whether the last flash operation went well.
    let register = match session.read_number(Address::new(program::ERROR_REGISTER, 0)) {
        Err(Error::NoAnswer { .. }) => None,
        register => optional(register)?,
    };
    let failed = register.is_some_and(|bits| bits & ERROR_BITS == ERROR_BITS);
    Ok(failed.then_some((FlashError::Unspecified, 0)))
}

/// Whether 1F56h of this bootloader is the CRC of the program, as far as its device type tells:
/// coboot's, and SYS TEC's.
///
/// # Errors
/// What a [read](Session::read) has.
pub(crate) fn knows_crc(session: &mut Session<'_>) -> Result<bool, Error> {
    let running = session.device_type()?;
    Ok(running.is_some_and(|running| running.0 == program::BOOTLOADER_DEVICE_TYPE))
}

/// Starts the program as the dialect has it; afterwards the session is with the node that it runs
/// as.
///
/// # Errors
/// [`Error::StartFailed`].
pub(crate) fn start(
    session: &mut Session<'_>,
    dialect: Dialect,
    original: NodeId,
    number: u8,
) -> Result<DeviceType, Error> {
    match dialect {
        Dialect::Block | Dialect::Raw | Dialect::Hex => crate::flash::start(session, number),
        Dialect::EsAcademy => {
            let boot = session.timing().boot;
            if let Some(running) = await_application(session, BY_ITSELF.min(boot))? {
                return Ok(running);
            }
            reset_program(session, number)?;
            arrived(session, number)
        }
        Dialect::Lift => {
            reset_program(session, LIFT_PROGRAM)?;
            if original == lift_node() {
                let boot = session.timing().boot;
                if let Some(node) = session.await_boot_up_of_another(boot)? {
                    session.talk_to(node);
                }
            } else {
                session.talk_to(original);
            }
            arrived(session, number)
        }
    }
}

/// Waits for the application.
fn arrived(session: &mut Session<'_>, number: u8) -> Result<DeviceType, Error> {
    let boot = session.timing().boot;
    if let Some(running) = await_application(session, boot)? {
        return Ok(running);
    }
    let (node, running) = (session.node(), session.device_type()?);
    Err(Error::StartFailed { node, running, status: session.status(number).ok() })
}

/// Reads an object of a device that has to be unlocked for it: a lift's program or parameter set,
/// from its bootloader. A device that was not there before is restarted afterwards, whatever came
/// of it.
///
/// # Errors
/// [`Error::NotInDialect`] for a device that is no lift, and what [`enter_lift`] and an
/// [upload](Session::upload) have.
pub fn read_locked(
    session: &mut Session<'_>,
    at: Address,
    dialect: Option<Dialect>,
    password: Option<Password>,
    tell: &mut dyn FnMut(Event),
) -> Result<Vec<u8>, Error> {
    let running = find(session)?;
    let dialect = match dialect {
        Some(dialect) => dialect,
        None => recognise(session, running, LIFT_PROGRAM)?,
    };
    let what = match dialect {
        Dialect::Lift => None,
        Dialect::EsAcademy => Some("the password erases the program, so there is nothing to read behind it"),
        Dialect::Block | Dialect::Raw | Dialect::Hex => Some("no password opens anything for reading"),
    };
    if let Some(what) = what {
        return Err(Error::NotInDialect { dialect, what });
    }
    let original = session.node();
    check_lift(session, running, password)?;
    enter_lift(session, password, tell)?;
    let bytes = session.upload(at, &mut |_| {});
    if original != session.node() && !matches!(bytes, Err(Error::Adapter(_))) {
        let restarted = reset_program(session, LIFT_PROGRAM);
        session.talk_to(original);
        restarted?;
    }
    bytes
}
