//! `coflash catch`: a device is held in its bootloader as soon as it has power.

use std::time::Duration;

use clap::Args;
use coflash::update::event::{Event, Phase};
use coflash::update::{catch, CatchOptions, Caught};
use serde_json::json;

use super::context::Context;
use super::device::Device;
use super::output::Failure;
use super::values::milliseconds;

/// Waits for a device that is switched on, and holds it in its bootloader.
///
/// For a device whose program does not answer: run this, then switch the device off and on. It is
/// asked ten times a second, so that its bootloader hears it before the program starts: one that was
/// never confirmed is held back for 300 ms. An application that answers is called back.
///
/// Not caught: a program that was confirmed once starts at once, so that its device needs its entry
/// strap.
#[derive(Debug, Args)]
pub(super) struct Catch {
    #[command(flatten)]
    device: Device,

    #[command(flatten)]
    limit: Limit,

    /// Whichever device comes up, whatever its node-ID, or without one. Every device that comes up
    /// meanwhile is held in its bootloader (by "identify non-configured slave" of LSS).
    #[arg(long)]
    any: bool,
}

/// How long to wait.
#[derive(Debug, Args)]
pub(super) struct Limit {
    /// Give up after this time, in milliseconds; otherwise Ctrl-C does.
    #[arg(long, value_parser = milliseconds, value_name = "MS")]
    within: Option<Duration>,
}

impl Limit {
    pub(super) fn is_set(&self) -> bool {
        self.within.is_some()
    }
}

impl Catch {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        run(context, "catch", &self.device, &self.limit, self.any)
    }
}

/// Catches a device, for the command of this name.
pub(super) fn run(
    context: &Context,
    command: &str,
    device: &Device,
    limit: &Limit,
    any: bool,
) -> Result<(), Failure> {
    let mut link = context.link()?;
    let mut session = device.session(&mut link)?;
    if any && !session.hears_the_bus() {
        let advice = "name the device by --node, or reach its CAN bus by an adapter";
        return Err(Failure::usage("a gateway does not tell who comes up", advice));
    }
    let began = session.now();
    let options = CatchOptions::default().any(any).within(limit.within);
    let whom = if any { "any device".to_string() } else { format!("node {}", session.node()) };
    let words = format!("{whom} comes up: switch the device off and on (Ctrl-C ends it)");
    if !context.out.shows_waiting() {
        context.out.say(format_args!("waiting until {words}"));
    }
    let waiting = context.waiting(words);
    let caught = catch(&mut session, &options, &mut |event| match event {
        // The line on the screen says it.
        Event::Phase(Phase::Searching { .. }) => {}
        event => waiting.beside(|| context.out.say(format_args!("  {event}"))),
    });
    drop(waiting);
    let Caught { node, running, .. } = caught.map_err(|error| Failure::diagnosed(error, &mut session))?;
    let seconds = session.now().saturating_sub(began).as_secs_f64();
    let words = match node {
        Some(node) => format!("node {node}: the bootloader is running, after {seconds:.1} s"),
        None => format!(
            "a device without node-ID is there, after {seconds:.1} s: give it one by coflash lss fastscan --assign"
        ),
    };
    context.out.result(words, || {
        json!({
            "command": command,
            "node": node.map(canopen::NodeId::get),
            "device_type": running.map(|running| running.0),
            "seconds": (seconds * 1000.0).round() / 1000.0,
        })
    });
    Ok(())
}
