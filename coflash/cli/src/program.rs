//! `coflash start`, `enter`, `erase`, `release`, `withdraw` and `status`: the single steps of an
//! update.

use canopen::program::ProgramState;
use clap::Args;
use coflash_core::device::info::program_info;
use coflash_core::device::Session;
use coflash_core::update::event::{Event, Phase};
use coflash_core::update::steps::{self, call_back, enter_bootloader, erase_at_once, reset_status};
use coflash_core::Error;
use serde_json::{json, Value};

use super::catch::{self, Limit};
use super::context::Context;
use super::device::Program;
use super::output::Failure;

/// Calls the application back to the bootloader.
///
/// It waits until the bootloader answers.
#[derive(Debug, Args)]
pub(super) struct Enter {
    #[command(flatten)]
    program: Program,

    /// Wait for a device that does not answer yet, like coflash more catch: the device may still be
    /// switched off.
    #[arg(long)]
    wait: bool,

    #[command(flatten)]
    limit: Limit,
}

/// Shows a program's state, CRC and flash status (1F51h, 1F56h, 1F57h).
#[derive(Debug, Args)]
pub(super) struct Status {
    #[command(flatten)]
    program: Program,

    /// First set the flash status to "no error".
    #[arg(long)]
    clear: bool,
}

/// Carries out a command on one program of one device, and shows the result. No second run of the tool
/// works on a device whose program one `erases`.
fn with(
    context: &Context,
    program: &Program,
    erases: bool,
    act: impl FnOnce(&mut Session<'_>, u8, &mut dyn FnMut(Event)) -> Result<(String, Value), Error>,
) -> Result<(), Failure> {
    let mut link = context.link()?;
    let mut session = program.device.session(&mut link)?;
    let _lock = erases.then(|| context.lock(context.bus.as_deref(), session.node())).transpose()?;
    let waiting =
        context.waiting(format!("node {} has carried out the command ({})", session.node(), context.command));
    let (words, more) = act(&mut session, program.program, &mut |event| context.out.detail(event))
        .map_err(|error| Failure::diagnosed(error, &mut session))?;
    drop(waiting);
    let node = session.node();
    context.result(format_args!("node {node}: {words}"), || {
        let mut value = json!({ "node": node.get(), "program": program.program });
        if let (Some(value), Value::Object(more)) = (value.as_object_mut(), more) {
            value.extend(more);
        }
        value
    });
    Ok(())
}

/// `coflash start`.
pub(super) fn start(context: &Context, program: &Program) -> Result<(), Failure> {
    with(context, program, false, |session, number, report| {
        let running = session.find()?;
        report(Event::Found(running));
        if !running.is_bootloader() {
            if runs(session, number)? {
                return Ok((format!("{running} is running already"), json!({ "running": running.0 })));
            }
            report(Phase::CallingBack.into());
            call_back(session)?;
            report(Phase::InBootloader.into());
        }
        let running = steps::start(session, number)?;
        Ok((format!("{running} is running"), json!({ "running": running.0 })))
    })
}

impl Enter {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        if self.wait || self.limit.is_set() {
            return catch::run(context, &self.program.device, &self.limit, false);
        }
        with(context, &self.program, false, |session, _, report| {
            let running = session.find()?;
            report(Event::Found(running));
            let words = if running.is_bootloader() {
                "the bootloader is running already"
            } else {
                call_back(session)?;
                "the bootloader is running"
            };
            Ok((words.to_string(), json!({})))
        })
    }
}

/// `coflash erase`.
pub(super) fn erase(context: &Context, program: &Program) -> Result<(), Failure> {
    with(context, program, true, |session, number, report| {
        session.ensure_alone()?;
        enter_bootloader(session, report)?;
        let began = session.now();
        erase_at_once(session, number)?;
        let seconds = session.now().saturating_sub(began).as_secs_f64();
        Ok((format!("program {number} is erased, in {seconds:.1} s"), json!({ "seconds": seconds })))
    })
}

/// `coflash more release`.
pub(super) fn release(context: &Context, program: &Program) -> Result<(), Failure> {
    with(context, program, false, |session, number, report| {
        // Report an absent device at once; the wait below is for a device that does not answer
        // the command.
        report(Event::Found(session.find()?));
        steps::release(session, number, report)?;
        Ok((format!("program {number} is released for autostart"), json!({})))
    })
}

/// `coflash more withdraw`.
pub(super) fn withdraw(context: &Context, program: &Program) -> Result<(), Failure> {
    with(context, program, false, |session, number, report| {
        report(Event::Found(session.find()?));
        steps::withdraw(session, number)?;
        let words =
            format!("program {number} is no longer released for autostart: it does not start by itself");
        Ok((words, json!({})))
    })
}

impl Status {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        with(context, &self.program, false, |session, number, report| {
            let running = session.find()?;
            report(Event::Found(running));
            if self.clear {
                reset_status(session, number)?;
            }
            let info = program_info(session, number)?;
            let value = json!({
                "device_type": running.0,
                "bootloader": running.is_bootloader(),
                "control": info.control,
                "crc": info.crc,
                "status": json!(info)["status"],
            });
            Ok((format!("{running}\n{}", info.to_string().trim_end()), value))
        })
    }
}

/// Whether this program runs, given that an application runs. A device that does not report it has
/// only one program.
fn runs(session: &mut Session<'_>, number: u8) -> Result<bool, Error> {
    let info = program_info(session, number)?;
    Ok(info.control.is_none_or(|state| state == ProgramState::Running as u32))
}
