//! The renewal of a device's bootloader: a new RAM image is staged, runs once on trial, and is confirmed;
//! then the device installs it (docs/renewal.md).

use std::time::Duration;

use canopen::program::{ProgramControl, PROGRAM_DATA};
use canopen::{Address, NodeId};
use shared_abi::renewal::{Origin, Progress, State, TrialEnd};

use super::aftermath::look;
use super::catch::knock;
use super::device_after::{DeviceAfterUpdate, DeviceAnswer, DeviceState};
use super::dialect;
use super::event::{Done, Event, Note, Phase, Report, Retry};
use super::judge::{judge, Judgement};
use super::new_bootloader::NewBootloader;
use super::options::FlashOptions;
use super::renewal::Renewal;
use super::running::{give_back, telling_silence, RunningUpdate};
use super::steps::{check_target, enter_bootloader, execute, identification, running_program, CALL_BACK};
use crate::device::access::{security_of, told_challenge};
use crate::device::error::told;
use crate::device::flying_master::Mastership;
use crate::device::renewal::{bootloader, progress, Bootloader};
use crate::device::{recognise, Dialect, Doing, Error, Session};

/// A device leaves its bootloader within this time after the answer to START.
const LEAVES_WITHIN: Duration = Duration::from_millis(200);
/// The old bootloader is usually back within this time: an image that nobody reaches, for example with
/// another bit rate, ends after 60 s; the watchdog ends one that hangs earlier. A product may have another
/// time (`renewal_s`), and no object has it: the user gives a longer one.
const TRIAL_ENDS_WITHIN: Duration = Duration::from_secs(75);

/// Renews the bootloader of a device; the program stays, and is started again if it ran before.
///
/// A renewal that was interrupted at any point can be started again at once: until the device has
/// confirmed the new bootloader, the old one comes back by itself.
///
/// # Errors
/// [`Error::NotRenewable`] for a device whose bootloader cannot be renewed, [`Error::RenewalFailed`] for
/// one whose new bootloader did not come up, [`Error::SilentOnTrial`] for one that does not answer on trial
/// and whose old bootloader is not back within 75 s or [`Timing::boot`](crate::device::Timing::boot),
/// whichever is longer, and the errors of [`flash`](super::flash()).
pub fn renew(
    session: &mut Session<'_>,
    new: &NewBootloader,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Renewal, Error> {
    let (result, node) = telling_silence(session, tell, |session, tell| {
        let result = procedure(session, new, options, tell);
        (result, session.node())
    });
    // The session may have followed a lift to its bootloader.
    session.talk_to(node);
    result
}

/// [`renew`] as an update of a device: with [`Event::Done`] at the end.
///
/// # Errors
/// Those of [`renew`].
pub(super) fn update(
    session: &mut Session<'_>,
    new: &NewBootloader,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Error> {
    let result = renew(session, new, options, tell).map(|renewal| Report {
        program_size: new.size(),
        program_crc: new.crc(),
        repeats: renewal.repeats,
        took: renewal.took,
        transfer: renewal.transfer,
        transfers: session.transfers(),
        running: renewal.running,
        released: None,
        dialect: Dialect::Block,
        renewal: Some(renewal),
    });
    let left = match &result {
        Ok(_) | Err(Error::NotAlone { .. }) => {
            DeviceAfterUpdate { state: DeviceState::Untouched, answer: DeviceAnswer::NotAsked }
        }
        Err(error) => left_by(session, error, options.program),
    };
    tell(Event::Done(Box::new(Done::new(left, &result))));
    result
}

/// The state of a device after a renewal that has failed: its program is as it was.
fn left_by(session: &mut Session<'_>, error: &Error, program: u8) -> DeviceAfterUpdate {
    let mut nobody = |_| {};
    let mut ended = RunningUpdate::new(&mut nobody);
    (ended.state, ended.touched) = (DeviceState::Called, true);
    let node = session.node();
    look(session, error, &ended, node, program, [0; 2])
}

fn procedure(
    session: &mut Session<'_>,
    new: &NewBootloader,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Renewal, Error> {
    let began = session.now();
    if options.alone && !options.wait {
        session.ensure_alone()?;
    }
    if options.wait {
        knock(session, None, tell)?;
    }
    if let Some(target) = options.check_target {
        session.find()?;
        check_target(session, target)?;
        tell(Note::TargetRight(target).into());
    }
    let program = running_program(session, CALL_BACK)?;
    let ran = session.device_type()?.is_some_and(|running| !running.is_bootloader());
    let mut way = Way { original: session.node(), dialect: Dialect::Block, mastership: None, options };
    let entered = way.enter(session, tell);
    let is_entered = entered.is_ok();
    let result = entered.and_then(|()| in_bootloader(session, new, &way, tell));
    // A program that ran before runs again, whatever became of the renewal. Nobody hears its start in a
    // device that is silent; the next power-on starts it there.
    let is_silent = matches!(result, Err(Error::SilentOnTrial { .. }));
    let again = program.filter(|_| ran && options.start && is_entered && !is_silent).map(|number| {
        tell(Phase::Starting.into());
        dialect::of(way.dialect).start(session, way.original, number)
    });
    if let Some(taken) = way.mastership.take() {
        give_back(session, taken, tell);
    }
    let renewal = result?;
    let running = again.transpose()?;
    if let Some(running) = running {
        tell(Phase::Started(running).into());
    }
    Ok(Renewal { running, took: session.now().saturating_sub(began), ..renewal })
}

/// The way into the bootloader, and what it wants there.
struct Way<'o> {
    /// The node at the start of the renewal: a lift's bootloader has another one.
    original: NodeId,
    /// The dialect of the bootloader.
    dialect: Dialect,
    /// The NMT mastership, while the tool holds it.
    mastership: Option<Mastership>,
    options: &'o FlashOptions,
}

impl Way<'_> {
    /// Makes the bootloader run. A lift gets its password for that, and the tool the NMT mastership.
    fn enter(&mut self, session: &mut Session<'_>, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
        let running = session.find()?;
        let found = match self.options.dialect {
            Some(dialect) => dialect,
            None => recognise(session, running, CALL_BACK)?,
        };
        if found == Dialect::Lift {
            tell(Event::Found(running));
            let mut update = RunningUpdate::new(tell);
            let entered = dialect::of(found).enter(session, running, self.options, &mut update);
            self.mastership = update.mastership.take();
            self.dialect = entered?;
            return Ok(());
        }
        enter_bootloader(session, tell)?;
        let running = session.device_type()?;
        let its = running.and_then(|running| Dialect::of_bootloader(running, session.node()));
        self.dialect = its.unwrap_or(found);
        Ok(())
    }

    /// Writes the password of the bootloader, if it has one: also after each reset.
    fn unlock(&self, session: &mut Session<'_>, number: u8) -> Result<(), Error> {
        dialect::of(self.dialect).unlock(session, self.options, number).map(drop)
    }
}

fn in_bootloader(
    session: &mut Session<'_>,
    new: &NewBootloader,
    way: &Way<'_>,
    tell: &mut dyn FnMut(Event),
) -> Result<Renewal, Error> {
    let (node, options) = (session.node(), way.options);
    let old = bootloader(session)?.ok_or(Error::NotRenewable { node })?;
    if let (NewBootloader::Plain(_), Some(challenge)) = (new, told_challenge(session)?) {
        if challenge.is_sealed() {
            let roots = security_of(session, &challenge)?.roots;
            return Err(Error::SealedOnly { node, roots });
        }
    }
    let number = old.number;
    let running = settled(session, old, way)?;
    let (from, to) = (old.version, new.version());
    let (mut repeats, mut transfer) = (0, Duration::ZERO);
    let unchanged =
        Renewal { number, from, to, unchanged: true, repeats, transfer, took: Duration::ZERO, running: None };
    let is_same = is_same(session, new, number)?;
    let is_open = running.origin == Origin::Trial && running.state == State::Staged;
    if is_same && running.state != State::Staged && !options.force {
        return Ok(unchanged);
    }
    tell(Phase::Renewing { number, from: from.0, to: to.0 }.into());
    if !(is_same && is_open) {
        leave_trial(session, number, running, way, tell)?;
        let began = session.now();
        repeats = stage(session, number, new, options, tell)?;
        transfer = session.now().saturating_sub(began);
        if progress(session)?.map(|progress| progress.state) != Some(State::Staged) {
            // The device has found the same image.
            return Ok(unchanged);
        }
        tell(Phase::Staged.into());
        try_it(session, number)?;
    }
    tell(Phase::OnTrial.into());
    if let Err(error) = way.unlock(session, number).and_then(|()| install(session, number)) {
        let is_refusal = matches!(error, Error::Failed { .. } | Error::Refused { .. });
        // A bootloader that is not confirmed need not wait for its end. The reason stays the result.
        match progress(session) {
            Ok(Some(running)) if is_refusal => drop(leave_trial(session, number, running, way, tell)),
            _ => {}
        }
        return Err(error);
    }
    match progress(session)? {
        Some(progress) if progress.state == State::Installed => {}
        other => {
            let end = other.map_or(TrialEnd::None, |progress| progress.trial_end);
            return Err(Error::RenewalFailed { node, end });
        }
    }
    let to = bootloader(session)?.map_or(to, |now| now.version);
    tell(Phase::Installed { version: to.0 }.into());
    Ok(Renewal { to, unchanged: false, repeats, transfer, ..unchanged })
}

/// Waits for an installation that goes on, and ends one that was broken off; what the device reports then.
/// From then on it is unlocked.
fn settled(session: &mut Session<'_>, old: Bootloader, way: &Way<'_>) -> Result<Progress, Error> {
    session.await_idle(old.number, Doing::Installation)?;
    way.unlock(session, old.number)?;
    let known =
        progress(session)?.unwrap_or_else(|| old.running.map(|running| running.progress).unwrap_or_default());
    if known.state != State::Confirmed {
        return Ok(known);
    }
    // No other image is taken before this one is installed.
    install(session, old.number)?;
    Ok(progress(session)?.unwrap_or(known))
}

/// Whether the device runs this image. A sealed image is judged by the device.
fn is_same(session: &mut Session<'_>, new: &NewBootloader, number: u8) -> Result<bool, Error> {
    let NewBootloader::Plain(image) = new else { return Ok(false) };
    Ok(identification(session, number)? == image.header().crc)
}

/// Ends a trial, whose image takes no other one. The one that comes back is unlocked.
fn leave_trial(
    session: &mut Session<'_>,
    number: u8,
    running: Progress,
    way: &Way<'_>,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    match running {
        // Without a record, a program has taken its flash.
        Progress { origin: Origin::Trial, state: State::Staged | State::None, .. } => {
            match session.command(number, ProgramControl::ClrSignature) {
                // One that wants a password, for example. Any reset ends its trial.
                Err(Error::Refused { .. }) => restart(session, number, way, tell),
                Err(error) => Err(error),
                Ok(()) => {
                    let limit = session.timing().boot;
                    let other = await_other_image(session, limit)?;
                    let node = session.node();
                    other.ok_or(Error::NoAnswer { node, doing: Doing::Restart })?;
                    way.unlock(session, number)
                }
            }
        }
        // It is installed: the next start loads it from home.
        Progress { origin: Origin::Trial, state: State::Installed, .. } => {
            restart(session, number, way, tell)
        }
        _ => Ok(()),
    }
}

/// Restarts the device, and brings it into its bootloader again.
fn restart(
    session: &mut Session<'_>,
    number: u8,
    way: &Way<'_>,
    tell: &mut dyn FnMut(Event),
) -> Result<(), Error> {
    session.reset_node()?;
    session.wait(LEAVES_WITHIN)?;
    session.talk_to(way.original);
    let options = FlashOptions { mastership: false, ..*way.options };
    let mut again = Way { options: &options, mastership: None, ..*way };
    again.enter(session, tell)?;
    again.unlock(session, number)
}

/// Downloads the image into staging; returns the number of repetitions.
fn stage(
    session: &mut Session<'_>,
    number: u8,
    new: &NewBootloader,
    options: &FlashOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<u32, Error> {
    let bytes = new.bytes();
    let total = bytes.len();
    let doing = Doing::Bootloader;
    let mut repeat = 0;
    loop {
        execute(session, number, ProgramControl::Clear)?;
        tell(Event::Progress { done: 0, total });
        let sent = session.write(Address::new(PROGRAM_DATA, number), bytes, doing, &mut |done| {
            tell(Event::Progress { done: done as usize, total });
        });
        if let Err(error @ (Error::Adapter(_) | Error::Cancelled)) = sent {
            return Err(error);
        }
        // 1F57h says more than an abort.
        let status = session.await_idle(number, doing)?;
        match judge(sent, status.error.map(|error| (error, status.detail)), doing) {
            Judgement::Good => return Ok(repeat),
            Judgement::Bad { why: Some(why), .. } if repeat < options.repeats => {
                repeat += 1;
                tell(Event::Retry(Retry::program(repeat, options.repeats, why)));
            }
            Judgement::Bad { error, .. } => return Err(error),
        }
    }
}

/// Confirms the image on trial, and waits until the device has installed it. 83h may be written twice.
fn install(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    match execute(session, number, ProgramControl::SetSignature) {
        Err(Error::Failed { error, detail, code, .. }) => {
            Err(Error::Failed { doing: Doing::Installation, error, detail, code })
        }
        result => result,
    }
}

/// Starts the staged image, and waits until it answers.
fn try_it(session: &mut Session<'_>, number: u8) -> Result<(), Error> {
    match session.command(number, ProgramControl::Start) {
        // A device that resets at once may not send its answer.
        Ok(()) | Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
        Err(error) => return Err(error),
    }
    let (node, limit) = (session.node(), TRIAL_ENDS_WITHIN.max(session.timing().boot));
    let progress = await_other_image(session, limit)?.ok_or(Error::SilentOnTrial { node, waited: limit })?;
    if progress.origin == Origin::Trial {
        return Ok(());
    }
    Err(Error::RenewalFailed { node, end: progress.trial_end })
}

/// Waits for the bootloader that comes up after a reset; what it reports, `None` if no bootloader answers
/// within `limit`.
fn await_other_image(session: &mut Session<'_>, limit: Duration) -> Result<Option<Progress>, Error> {
    // The old one still answers for a moment.
    session.wait(LEAVES_WITHIN)?;
    let began = session.now();
    loop {
        let pause = session.timing().sdo;
        match session.device_type()? {
            Some(running) if running.is_bootloader() => match told(progress(session))? {
                Some(Some(progress)) => return Ok(Some(progress)),
                // A state of a later version.
                Some(None) => return Err(Error::Unconfirmable { node: session.node() }),
                None => {
                    // It knows nothing of its trial, and does not end it. Any reset does.
                    session.reset_node()?;
                    return Err(Error::Unconfirmable { node: session.node() });
                }
            },
            _ if session.now() >= began + limit => return Ok(None),
            _ => session.note_silence(began, limit, Doing::Restart),
        }
        session.await_boot_up(pause)?;
    }
}
