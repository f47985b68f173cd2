//! `coflash seal unlock` and `events`: what the holder of the root key can do with a sealed device.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use coflash_core::device::access::{ask, challenge, events};
use seal::access::right;
use serde_json::json;

use crate::context::Context;
use crate::device::Device;
use crate::output::Failure;
use crate::seal::keys::signing_key;
use crate::values::number;

/// Asks a sealed device for rights, by a root key.
///
/// The device must be in its bootloader. Rights last until its next reset. After a wrong signature
/// the device waits before it accepts another one; the wait grows with each wrong signature.
#[derive(Debug, Args)]
pub(crate) struct Unlock {
    /// The rights to ask for, separated by commas.
    #[arg(value_enum, value_delimiter = ',', required = true)]
    rights: Vec<Right>,

    /// The private key of one of the device's roots.
    #[arg(long, value_name = "FILE")]
    root: PathBuf,

    /// The security counter of the one image to install, which is lower than the device's counter.
    #[arg(long, value_name = "NUMBER", value_parser = number, required_if_eq("rights", "lower-counter"))]
    counter: Option<u32>,

    #[command(flatten)]
    device: Device,
}

/// A right.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Right {
    /// Erase a program without installing another one.
    Erase,
    /// Withdraw a program's release for autostart.
    Withdraw,
    /// Install one program with a lower security counter.
    LowerCounter,
    /// Store node-ID and bit rate by LSS.
    Store,
    /// Read programs back.
    ReadBack,
    /// Leave the sealed state permanently from the next reset on: the device then accepts and
    /// starts any program.
    Open,
}

impl Right {
    const fn bit(self) -> u32 {
        match self {
            Self::Erase => right::ERASE,
            Self::Withdraw => right::CLEAR_SIGNATURE,
            Self::LowerCounter => right::LOWER_COUNTER,
            Self::Store => right::STORE,
            Self::ReadBack => right::READ_BACK,
            Self::Open => right::OPEN,
        }
    }
}

/// Shows the events that a sealed device has recorded.
///
/// They are the last eight installations, refusals and grants of rights.
#[derive(Debug, Args)]
pub(crate) struct Events {
    #[command(flatten)]
    device: Device,
}

impl Unlock {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let key = signing_key(&self.root)?;
        let rights = self.rights.iter().fold(0, |bits, right| bits | right.bit());
        let asked = (rights, self.counter.unwrap_or(0), key.public().id());
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let node = session.node();
        let waiting = context.waiting(format!("node {node} has checked the signature"));
        let granted = challenge(&mut session)
            .and_then(|challenge| {
                let signature = key.sign(&challenge.tbs(asked.0, asked.1, asked.2));
                ask(&mut session, asked, &signature)
            })
            .map_err(|error| Failure::diagnosed(error, &mut session))?;
        drop(waiting);
        if !granted {
            return Err(Failure::usage(
                format!("node {node} has not granted the rights"),
                "use the private key of one of the device's roots (coflash seal keys show), and wait half a minute",
            ));
        }
        let words = if rights & right::OPEN != 0 {
            "rights granted; the device is open from the next reset on (coflash reset)"
        } else {
            "rights granted until the next reset"
        };
        context
            .result(format_args!("node {node}: {words}"), || json!({ "node": node.get(), "rights": rights }));
        Ok(())
    }
}

impl Events {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let recorded = events(&mut session).map_err(|error| Failure::diagnosed(error, &mut session))?;
        let node = session.node();
        let lines: String = recorded.iter().map(|event| format!("\n{event}")).collect();
        let words =
            if recorded.is_empty() { "no events are recorded" } else { "recorded events, the newest first" };
        context.result(format_args!("node {node}: {words}{lines}"), || {
            let events: Vec<_> = recorded
                .iter()
                .map(|event| {
                    json!({
                        "number": event.number,
                        "what": event.what,
                        "counter": event.counter,
                        "version": event.version,
                        "text": event.to_string().trim(),
                    })
                })
                .collect();
            json!({ "node": node.get(), "events": events })
        });
        Ok(())
    }
}
