//! `coflash more catch`: holds a device in its bootloader as soon as it has power.

use std::time::Duration;

use clap::Args;
use coflash_core::update::event::{Event, Phase};
use coflash_core::update::{catch, CatchOptions, Caught};
use serde_json::json;

use crate::context::Context;
use crate::device::Device;
use crate::output::Failure;
use crate::values::milliseconds;

/// Waits until a device is switched on, and holds it in its bootloader.
///
/// Use this for a device whose program does not answer: run the command, then switch the device off
/// and on. The tool sends requests to the device ten times a second, so that its bootloader
/// receives one before it starts the program: it holds back a program that was never confirmed for
/// 300 ms. An application that answers is called back.
///
/// The command cannot catch a device whose program was confirmed once: that program starts at once.
/// Use the device's entry strap instead.
#[derive(Debug, Args)]
pub(crate) struct Catch {
    #[command(flatten)]
    device: Device,

    #[command(flatten)]
    limit: Limit,

    /// Catch any device, whatever its node-ID, and also one without a node-ID. Every device that
    /// starts meanwhile is held in its bootloader (by "identify non-configured slave" of LSS).
    #[arg(long)]
    any: bool,
}

/// How long to wait.
#[derive(Debug, Args)]
pub(crate) struct Limit {
    /// Give up after this time, in milliseconds. Without it, Ctrl-C ends the wait.
    #[arg(long, value_parser = milliseconds, value_name = "MS")]
    within: Option<Duration>,
}

impl Limit {
    pub(crate) fn is_set(&self) -> bool {
        self.within.is_some()
    }
}

impl Catch {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        run(context, &self.device, &self.limit, self.any)
    }
}

/// Catches a device.
pub(crate) fn run(context: &Context, device: &Device, limit: &Limit, any: bool) -> Result<(), Failure> {
    let mut link = context.link()?;
    let mut session = device.session(&mut link)?;
    if any && !session.hears_the_bus() {
        let advice = "name the device with --node, or connect to its CAN bus with an adapter";
        return Err(Failure::usage("a gateway does not report which device starts", advice));
    }
    let began = session.now();
    let options = CatchOptions::default().any(any).within(limit.within);
    let whom = if any { "any device".to_string() } else { format!("node {}", session.node()) };
    let words = format!("{whom} starts: switch the device off and on (Ctrl-C ends the wait)");
    if !context.out.shows_waiting() {
        context.out.say(format_args!("waiting until {words}"));
    }
    let waiting = context.waiting(words);
    let caught = catch(&mut session, &options, &mut |event| match event {
        // The line on the screen already says this.
        Event::Phase(Phase::Searching { .. }) => {}
        event => waiting.beside(|| context.out.say(format_args!("  {event}"))),
    });
    drop(waiting);
    let Caught { node, running, .. } = caught.map_err(|error| Failure::diagnosed(error, &mut session))?;
    let seconds = session.now().saturating_sub(began).as_secs_f64();
    let words = match node {
        Some(node) => format!("node {node}: the bootloader is running, after {seconds:.1} s"),
        None => format!(
            "a device without a node-ID started, after {seconds:.1} s: give it one with coflash lss fastscan --assign"
        ),
    };
    context.result(words, || {
        json!({
            "node": node.map(canopen::NodeId::get),
            "device_type": running.map(|running| running.0),
            "seconds": (seconds * 1000.0).round() / 1000.0,
        })
    });
    Ok(())
}
