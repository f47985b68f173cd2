//! The renewal of a device's bootloader: a new RAM image is staged, runs once on trial, and is confirmed;
//! then the device installs it (docs/renewal.md). It is the same in every dialect but for the password.

use std::time::Duration;

use canopen::program::ProgramControl;
use shared_abi::renewal::{Origin, Progress, State, TrialEnd};

use super::of;
use super::procedure::{self, call_back, Downloaded, Procedure};
use crate::device::access::takes_open;
use crate::device::error::reported;
use crate::device::renewal::{bootloader, progress, Bootloader};
use crate::device::{Dialect, Doing, Error, Form, Session};
use crate::update::device_after::DeviceState;
use crate::update::event::Phase;
use crate::update::judge::DownloadStatus;
use crate::update::options::FlashOptions;
use crate::update::payload::Payload;
use crate::update::reach::{find, Found};
use crate::update::report::Renewal;
use crate::update::running::RunningUpdate;
use crate::update::steps::{execute, identification};

/// A device leaves its bootloader within this time after the answer to START.
const LEAVES_WITHIN: Duration = Duration::from_millis(200);
/// The old bootloader is usually back within this time: an image that nobody reaches, for example with
/// another bit rate, ends after 60 s; the watchdog ends one that hangs earlier. A product may have another
/// time (`renewal.confirm_within_s`), and no object has it: the user gives a longer one.
const TRIAL_ENDS_WITHIN: Duration = Duration::from_secs(75);

/// See the [module](self).
pub(in crate::update) struct Renew;

impl Procedure for Renew {
    /// A lift gets its password for that, and the tool the NMT mastership.
    fn enter(
        &self,
        session: &mut Session<'_>,
        found: Found,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Dialect, Error> {
        match found.dialect {
            Dialect::Lift => of(Dialect::Lift).enter(session, found, update),
            _ => call_back(session, found, update),
        }
    }

    /// Renews the bootloader. The program stays, and is started again if it ran before.
    ///
    /// # Errors
    /// [`Error::NotRenewable`] for a device whose bootloader cannot be renewed, [`Error::RenewalFailed`]
    /// for one whose new bootloader did not come up, [`Error::SilentOnTrial`] for one that does not answer
    /// on trial and whose old bootloader is not back within 75 s or
    /// [`Timing::boot`](crate::device::Timing::boot), whichever is longer.
    fn download(
        &self,
        session: &mut Session<'_>,
        file: &Payload,
        update: &mut RunningUpdate<'_>,
    ) -> Result<Downloaded, Error> {
        update.known.touched = true;
        let result = renew(session, file, update);
        // A program that ran before runs again, whatever became of the renewal. Nobody hears its start in
        // a device that is silent; the next power-on starts it there.
        let is_silent = matches!(result, Err(Error::SilentOnTrial { .. }));
        let again = update.called.filter(|_| update.options.start && !is_silent).map(|program| {
            update.report(Phase::Starting.into());
            of(update.dialect).start(session, update.original, program)
        });
        let renewal = result?;
        let running = again.transpose()?;
        if let Some(running) = running {
            update.report(Phase::Started(running).into());
        }
        // The new bootloader has answered, which is a verdict.
        let state = if renewal.unchanged { DeviceState::Untouched } else { DeviceState::Renewed };
        (update.known.state, update.losses) = (state, None);
        let Renewal { repeats, transfer: took, .. } = renewal;
        Ok(Downloaded { repeats, took, released: None, renewal: Some(Renewal { running, ..renewal }) })
    }

    fn prepare(&self, session: &mut Session<'_>, number: u8, _: &mut RunningUpdate<'_>) -> Result<(), Error> {
        execute(session, number, ProgramControl::Clear)
    }

    fn status(&self, session: &mut Session<'_>, number: u8, doing: Doing) -> Result<DownloadStatus, Error> {
        procedure::idle(session, number, doing)
    }
}

fn renew(
    session: &mut Session<'_>,
    file: &Payload,
    update: &mut RunningUpdate<'_>,
) -> Result<Renewal, Error> {
    let node = session.node();
    let old = bootloader(session)?.ok_or(Error::NotRenewable { node })?;
    if let Payload::Bootloader(_) = file {
        takes_open(session)?;
    }
    let (number, from, to) = (old.number, old.version, file.bootloader().unwrap_or(old.version));
    let running = settled(session, old, update)?;
    let (mut repeats, mut transfer) = (0, Duration::ZERO);
    let unchanged =
        Renewal { number, from, to, unchanged: true, repeats, transfer, took: Duration::ZERO, running: None };
    let is_same = from == to && is_same(session, file, number)?;
    let is_open = running.origin == Origin::Trial && running.state == State::Staged;
    if is_same && running.state != State::Staged && !update.options.force {
        return Ok(unchanged);
    }
    update.report(Phase::Renewing { number, from: from.0, to: to.0 }.into());
    let is_tried = is_same && is_open;
    if !is_tried {
        leave_trial(session, number, running, update)?;
        let began = session.now();
        let content = file.encoded(Form::Image);
        repeats = procedure::send(&Renew, session, number, &content, Doing::Bootloader, update)?;
        transfer = session.now().saturating_sub(began);
        if progress(session)?.map(|progress| progress.state) != Some(State::Staged) {
            // The device has found the same image.
            return Ok(unchanged);
        }
        update.report(Phase::Staged.into());
    }
    // From here on a silence may be that of the image on trial, or of the adapter.
    update.losses = Some(session.losses());
    if !is_tried {
        try_it(session, number)?;
    }
    update.report(Phase::OnTrial.into());
    if let Err(error) = unlock(session, number, update).and_then(|()| install(session, number)) {
        let is_refusal = matches!(error, Error::Failed { .. } | Error::Refused { .. });
        // A bootloader that is not confirmed need not wait for its end. The reason stays the result.
        match progress(session) {
            Ok(Some(running)) if is_refusal => drop(leave_trial(session, number, running, update)),
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
    update.report(Phase::Installed { version: to.0 }.into());
    Ok(Renewal { to, unchanged: false, repeats, transfer, ..unchanged })
}

/// Writes the password of the bootloader, if it has one: also after each reset.
fn unlock(session: &mut Session<'_>, number: u8, update: &RunningUpdate<'_>) -> Result<(), Error> {
    of(update.dialect).unlock(session, update.options.unlock, number).map(drop)
}

/// Waits for an installation that goes on, and ends one that was broken off; what the device reports then.
/// From then on it is unlocked.
fn settled(
    session: &mut Session<'_>,
    old: Bootloader,
    update: &RunningUpdate<'_>,
) -> Result<Progress, Error> {
    session.await_idle(old.number, Doing::Installation)?;
    unlock(session, old.number, update)?;
    let known =
        progress(session)?.unwrap_or_else(|| old.running.map(|running| running.progress).unwrap_or_default());
    if known.state != State::Confirmed {
        return Ok(known);
    }
    // No other image is taken before this one is installed.
    install(session, old.number)?;
    Ok(progress(session)?.unwrap_or(known))
}

/// Ends a trial, whose image takes no other one. The one that comes back is unlocked.
fn leave_trial(
    session: &mut Session<'_>,
    number: u8,
    running: Progress,
    update: &mut RunningUpdate<'_>,
) -> Result<(), Error> {
    match running {
        // Without a record, a program has taken its flash.
        Progress { origin: Origin::Trial, state: State::Staged | State::None, .. } => {
            match session.command(number, ProgramControl::ClrSignature) {
                // One that wants a password, for example. Any reset ends its trial.
                Err(Error::Refused { .. }) => restart(session, number, update),
                Err(error) => Err(error),
                Ok(()) => {
                    let limit = session.timing().boot;
                    let other = await_other_image(session, limit)?;
                    let node = session.node();
                    other.ok_or(Error::NoAnswer { node, doing: Doing::Restart })?;
                    unlock(session, number, update)
                }
            }
        }
        // It is installed: the next start loads it from home.
        Progress { origin: Origin::Trial, state: State::Installed, .. } => restart(session, number, update),
        _ => Ok(()),
    }
}

/// Restarts the device, and brings it into its bootloader again.
fn restart(session: &mut Session<'_>, number: u8, update: &mut RunningUpdate<'_>) -> Result<(), Error> {
    session.reset_node()?;
    session.wait(LEAVES_WITHIN)?;
    session.talk_to(update.original);
    let (called, options) = (update.called, update.options);
    // The tool has what it wants of the master, and knows the device.
    update.options = FlashOptions { mastership: false, check_target: None, ..options };
    let entered = find(session, update).and_then(|found| Renew.enter(session, found, update));
    // A program that has started by itself meanwhile did not run before.
    (update.called, update.options) = (called, options);
    entered?;
    unlock(session, number, update)
}

/// Whether the device runs this image. A sealed image is judged by the device.
fn is_same(session: &mut Session<'_>, file: &Payload, number: u8) -> Result<bool, Error> {
    Ok(matches!(file, Payload::Bootloader(_)) && identification(session, number)? == file.crc())
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
            Some(running) if running.is_bootloader() => match reported(progress(session))? {
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
