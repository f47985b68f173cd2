//! `coflash more conform`: conformance checks on a device.

use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use canopen::NodeId;
use clap::Args;
use coboot_can::Adapter;
use coflash_conform::{checks, junit, run, Check, Means, Outcome, Power, Verdict};
use coflash_core::device::option_bytes::OptionBytes;
use coflash_core::device::read_state::read_state;
use coflash_core::device::{Session, Timing};
use coflash_core::file::convert::Label;
use coflash_core::update::Payload;
use serde_json::json;

use crate::context::Context;
use crate::device::cancelled;
use crate::file::{warn, Source};
use crate::output::Failure;
use crate::output_file;
use crate::values::{milliseconds, node_id};

/// Checks whether a device conforms to CiA 301 and CiA 305, with a verdict for each check.
///
/// No check touches the program, unless --install asks for it. The device is left in the NMT state in
/// which it was found, also after Ctrl-C. Checks that reset the device run only with --reset.
#[derive(Debug, Args)]
pub(crate) struct Conform {
    /// The checks or groups to run, for example SDO or SDO-003; by default all.
    #[arg(value_name = "CHECK")]
    checks: Vec<String>,

    /// The device's node-ID.
    #[arg(long, short = 'N', alias = "node_id", default_value = "1", value_parser = node_id, value_name = "1..127")]
    node: NodeId,

    /// Only list the checks.
    #[arg(long)]
    list: bool,

    /// Also run the checks that reset the device; a bootloader may then start its program.
    #[arg(long)]
    reset: bool,

    /// Also run the checks that erase the device and install --image, which runs at the end.
    #[arg(long, requires = "image")]
    install: bool,

    /// The program for --install.
    #[arg(long, value_name = "FILE", requires = "install")]
    image: Option<PathBuf>,

    #[command(flatten)]
    source: Source,

    /// The command that switches the device's power, for the power cut of --install; {state} becomes
    /// on or off.
    #[arg(long, value_name = "COMMAND", requires = "install")]
    power_command: Option<String>,

    /// Write the report as JUnit XML to this file.
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,

    /// The longest time for an answer, in milliseconds.
    #[arg(long, default_value = "500", value_parser = milliseconds, value_name = "MS")]
    answer_timeout: Duration,
}

impl Conform {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let chosen = self.chosen()?;
        if self.list {
            let line = |check: &Check| format!("{:9} {} ({})", check.id, check.title, check.clause);
            let lines: Vec<_> = chosen.iter().map(line).collect();
            context.result(lines.join("\n"), || {
                let list: Vec<_> = chosen
                    .iter()
                    .map(|c| {
                        json!({ "id": c.id, "title": c.title, "clause": c.clause, "resets": c.resets,
                                       "installs": c.installs })
                    })
                    .collect();
                json!({ "checks": list })
            });
            return Ok(());
        }
        let image = self.image(context)?;
        self.junit.as_deref().map_or(Ok(()), output_file::ready)?;
        let _lock = context.lock(context.bus.as_deref(), self.node)?;
        let mut adapter = context.open()?;
        let warnings = self.warnings(&mut *adapter);
        warnings.iter().for_each(|warning| context.out.warn(warning));
        let report = &mut |verdict: &Verdict| {
            let (word, why) = words(&verdict.outcome);
            let why = if why.is_empty() { String::new() } else { format!(": {why}") };
            context.out.say(format_args!("{:9} {word:7} {}{why}", verdict.check.id, verdict.check.title));
        };
        let is_asked = |check: &Check| (self.reset || !check.resets) && (self.install || !check.installs);
        let chosen: Vec<_> = chosen.into_iter().filter(is_asked).collect();
        let means = Means { answer: self.answer_timeout, image, power: self.power() };
        let verdicts = run(&mut *adapter, self.node, &chosen, means, &cancelled()?, report)?;
        if let Some(path) = &self.junit {
            output_file::write(path, junit(&verdicts).as_bytes())?;
        }
        let count = |word: &str| verdicts.iter().filter(|v| words(&v.outcome).0 == word).count();
        let (passed, failed, skipped) = (count("passed"), count("FAILED"), count("skipped"));
        context.result(format_args!("{passed} passed, {failed} failed, {skipped} skipped"), || {
            let list: Vec<_> = verdicts
                .iter()
                .map(|Verdict { check, outcome }| {
                    let (word, why) = words(outcome);
                    json!({ "id": check.id, "title": check.title, "clause": check.clause,
                            "outcome": word.to_lowercase(), "why": why })
                })
                .collect();
            json!({ "node": self.node.get(), "passed": passed, "failed": failed,
                    "skipped": skipped, "checks": list, "warnings": warnings })
        });
        if failed == 0 {
            Ok(())
        } else {
            Err(Failure::nonconforming(self.node, failed))
        }
    }

    /// The program of --image.
    fn image(&self, context: &Context) -> Result<Option<Payload>, Failure> {
        let Some(path) = &self.image else { return Ok(None) };
        let (firmware, _) = self.source.load(path, 1)?;
        let done = self.source.convert(firmware, path, 1, Label::OfImage { date: 0 })?;
        warn(context, path, &done.notes, done.left_out);
        Ok(Some(Arc::new(done.program).into()))
    }

    /// What a product needs beside a device that conforms: the option bytes of its chip.
    fn warnings(&self, adapter: &mut dyn Adapter) -> Vec<&'static str> {
        let mut session = Session::new(adapter, self.node, Timing::default());
        // A device that does not say is judged by the checks.
        let state = read_state(&mut session).ok().flatten();
        state.and_then(|state| state.option_bytes).map(OptionBytes::warnings).unwrap_or_default()
    }

    /// The power of the device, by the user's command.
    fn power(&self) -> Option<Power<'_>> {
        let command = self.power_command.as_ref()?;
        Some(Box::new(move |on| {
            let line = command.replace("{state}", if on { "on" } else { "off" });
            let (shell, flag) = if cfg!(windows) { ("cmd", "/C") } else { ("sh", "-c") };
            match Command::new(shell).args([flag, &line]).status() {
                Ok(status) if status.success() => Ok(()),
                Ok(status) => Err(format!("'{line}' has failed ({status})")),
                Err(error) => Err(format!("'{line}' cannot be run: {error}")),
            }
        }))
    }

    fn chosen(&self) -> Result<Vec<Check>, Failure> {
        let all = checks();
        if let Some(word) = self.checks.iter().find(|word| !all.iter().any(|check| check.is_named(word))) {
            let advice = "coflash more conform --list shows the checks";
            return Err(Failure::usage(format!("there is no check and no group '{word}'"), advice));
        }
        let wanted = |check: &Check| self.checks.is_empty() || self.checks.iter().any(|w| check.is_named(w));
        Ok(all.into_iter().filter(wanted).collect())
    }
}

fn words(outcome: &Outcome) -> (&'static str, &str) {
    match outcome {
        Outcome::Passed => ("passed", ""),
        Outcome::Failed(what) => ("FAILED", what),
        Outcome::Skipped(why) => ("skipped", why),
    }
}
