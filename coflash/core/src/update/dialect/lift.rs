//! The dialect `lift`: CiA 417, as CiA 814-1 describes it. The bootloader is node 126.

use std::time::Duration;

use canopen::nmt::parse_state_message;
use canopen::program::LIFT_NODE_ID;
use canopen::{AbortCode, Address, NodeId};

use super::procedure::Procedure;
use crate::device::flying_master::{self, Asked};
use crate::device::info::nameplate;
use crate::device::recognise::UNLOCK;
use crate::device::{recognise, DeviceType, Dialect, Doing, Error, Session, Timing};
use crate::update::event::{Event, Note, Phase, Warning};
use crate::update::options::FlashOptions;
use crate::update::password::Password;
use crate::update::reach::Found;
use crate::update::running::{Known, RunningUpdate};
use crate::update::steps::{await_program, reset_program, settle};

/// The program of a lift device; the other sub-indices of 1F50h hold data, which are not started
/// (CiA 814-1 clause 6.4).
pub(super) const LIFT_PROGRAM: u8 = 1;
/// How long a lift bootloader may take to start (CiA 814-1 clause 6.3).
const LIFT_WAIT: Duration = Duration::from_secs(10);
/// The pause between two requests meanwhile: a device that detects the bit rate needs traffic on the
/// bus.
const LIFT_PAUSE: Duration = Duration::from_millis(125);
/// How long to wait for a heartbeat: in most networks, heartbeats come once a second.
const HEARTBEAT: Duration = Duration::from_millis(1200);

/// See the [module](self).
pub(super) struct Lift;

impl Procedure for Lift {
    fn judge_password(&self, node: NodeId, password: Option<Password>) -> Result<(), Error> {
        password.map(|_| ()).ok_or(Error::NoPassword { node })
    }

    fn enter(
        &self,
        session: &mut Session<'_>,
        found: Found,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Dialect, Error> {
        let options = update.options;
        if !options.follow {
            let what = "the bootloaders share a node-ID: update the devices one after the other";
            return Err(Error::NotInDialect { dialect: Dialect::Lift, what });
        }
        update.report(Note::Dialect { dialect: Dialect::Lift }.into());
        update.report(Note::Nameplate(Box::new(nameplate(session)?)).into());
        check(session, found.running, options.unlock)?;
        if options.mastership {
            match flying_master::ask(session)? {
                Asked::Nobody => {}
                Asked::Kept(master) => update.report(Warning::MasterKept { node: master.node }.into()),
                Asked::Taken(taken) => {
                    update.report(Note::MasterTaken { node: taken.from.node }.into());
                    update.mastership = Some(taken);
                }
            }
        }
        unlock_bootloader(session, options.unlock, update)?;
        Ok(Dialect::Lift)
    }

    /// The device is already unlocked; the download overwrites the old program.
    fn prepare(&self, _: &mut Session<'_>, _: u8, _: &mut RunningUpdate<'_>) -> Result<(), Error> {
        Ok(())
    }

    fn unlock(&self, session: &mut Session<'_>, password: Option<Password>, _: u8) -> Result<bool, Error> {
        let password = password.ok_or(Error::NoPassword { node: session.node() })?;
        unlock(session, password).map(|()| true)
    }

    fn start(&self, session: &mut Session<'_>, original: NodeId, number: u8) -> Result<DeviceType, Error> {
        reset_program(session, LIFT_PROGRAM)?;
        if original == lift_node() {
            let boot = session.timing().boot;
            if let Some(node) = session.await_boot_up_of_another(boot)? {
                session.talk_to(node);
            }
        } else {
            session.talk_to(original);
        }
        // The boot-up that led to this node is no other device's.
        let began = session.now();
        await_program(session, number, began)
    }
}

/// Calls a lift device into its bootloader and unlocks it there (CiA 814-1 clause 6.3). The session
/// then talks to node 126. [`check`] must run before.
///
/// # Errors
/// [`Error::NoPassword`], [`Error::NoBootloader`], and [`Error::Refused`] for a wrong password.
fn unlock_bootloader(
    session: &mut Session<'_>,
    password: Option<Password>,
    update: &mut RunningUpdate<'_>,
) -> Result<(), Error> {
    let node = session.node();
    let password = password.ok_or(Error::NoPassword { node })?;
    let lift = lift_node();
    if node != lift {
        unlock(session, password)?;
        update.report(Note::Unlocked.into());
        update.calls(Some(LIFT_PROGRAM));
        update.called = Some(LIFT_PROGRAM);
        update.report(Phase::CallingBack.into());
        match reset_program(session, LIFT_PROGRAM) {
            // It knows the command, and does not leave.
            Err(Error::Refused { node, code, .. }) => {
                let running = session.device_type()?;
                return Err(Error::NoBootloader { node, running, code: Some(code), elsewhere: None });
            }
            restarted => restarted?,
        }
        session.talk_to(lift);
        let timing = Timing { boot: LIFT_WAIT.max(session.timing().boot), ..brief(session.timing()) };
        let running = settle(&mut session.with(lift, timing), DeviceType::is_bootloader)?;
        if !running.is_some_and(DeviceType::is_bootloader) {
            return Err(Error::NoBootloader { node: lift, running, code: None, elsewhere: None });
        }
        update.report(Note::Moved { node: lift }.into());
        update.report(Phase::InBootloader.into());
    }
    unlock(session, password)?;
    update.report(Note::Unlocked.into());
    Ok(())
}

/// Checks whether a lift device can be updated, before it is changed: the user gave a password, and
/// no other device has node-ID 126, not even one that only sends heartbeats (CiA 814-1 clause 6.3).
///
/// # Errors
/// [`Error::NoPassword`], [`Error::Occupied`], [`Error::NoBootloader`].
fn check(session: &mut Session<'_>, running: DeviceType, password: Option<Password>) -> Result<(), Error> {
    let (node, lift) = (session.node(), lift_node());
    if password.is_none() {
        return Err(Error::NoPassword { node });
    }
    if node == lift {
        return if running.is_bootloader() {
            Ok(())
        } else {
            Err(Error::NoBootloader { node, running: Some(running), code: None, elsewhere: None })
        };
    }
    let mut asked = session.with(lift, brief(session.timing()));
    let there = asked.device_type()?.is_some()
        || asked.hears_the_bus()
            && asked.observe_until(HEARTBEAT, &mut |frame| {
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

/// Time limits for a single, short request.
fn brief(timing: &Timing) -> Timing {
    Timing { sdo: LIFT_PAUSE.min(timing.sdo), attempts: 1, ..*timing }
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

/// Reads an object of a locked device: a lift's program or parameter set, from its bootloader. If
/// the device was not in the bootloader before, it is restarted afterwards, also after an error.
///
/// # Errors
/// [`Error::NotInDialect`] for a device that is not a lift device, [`Error::NoPassword`],
/// [`Error::Occupied`], [`Error::NoBootloader`], and the errors of an [upload](Session::upload).
pub fn read_locked(
    session: &mut Session<'_>,
    at: Address,
    dialect: Option<Dialect>,
    password: Option<Password>,
    on_event: &mut dyn FnMut(Event),
) -> Result<Vec<u8>, Error> {
    let original = session.node();
    // A dialect that is named is judged before the first frame.
    if let Some(dialect) = dialect {
        reads_locked(dialect)?;
        Lift.judge_password(original, password)?;
    }
    let running = session.find()?;
    if dialect.is_none() {
        reads_locked(recognise(session, running, LIFT_PROGRAM)?)?;
    }
    check(session, running, password)?;
    unlock_bootloader(
        session,
        password,
        &mut RunningUpdate::new(original, FlashOptions::default(), &mut Known::default(), on_event),
    )?;
    let bytes = session.upload(at, &mut |_| {});
    if original != session.node() && !matches!(bytes, Err(Error::Adapter(_))) {
        let restarted = reset_program(session, LIFT_PROGRAM);
        session.talk_to(original);
        restarted?;
    }
    bytes
}

/// Whether a password allows reading in this dialect.
///
/// # Errors
/// [`Error::NotInDialect`].
fn reads_locked(dialect: Dialect) -> Result<(), Error> {
    let what = match dialect {
        Dialect::Lift => return Ok(()),
        _ if dialect.has_password() => "the password erases the program, so there is nothing left to read",
        _ => "no password allows reading",
    };
    Err(Error::NotInDialect { dialect, what })
}
