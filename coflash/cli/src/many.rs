//! The output of an update of many devices, for people and for programs.

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use canopen::NodeId;
use coboot_can::wall;
use coflash_core::device::diagnose::{diagnose, Diagnosis};
use coflash_core::device::Session;
use coflash_core::update::many::Failed;
use coflash_core::update::{stamp, Event, Report};
use coflash_core::Error;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget};
use serde_json::{json, Value};

use super::events::Lines;
use super::output::{Failure, Output};
use super::output_file;
use super::record;
use super::waiting::style;

pub(super) const STYLE: &str = "{prefix:<9} {bar:30} {percent:>3} %  {rate:>12}  {msg}";

/// Progress of each device: a bar on a terminal, and otherwise lines that begin with the node.
pub(super) struct Board {
    out: Output,
    nodes: Vec<NodeId>,
    names: Vec<String>,
    form: Form,
}

enum Form {
    Terminal(Vec<ProgressBar>),
    /// On a pipe or in a file: the tenths that were shown, for each device.
    Plain(Mutex<Vec<usize>>),
    /// The output for programs.
    Lines(Mutex<Vec<Lines>>),
}

impl Board {
    pub(super) fn new(out: Output, nodes: &[NodeId]) -> Self {
        let names: Vec<String> = nodes.iter().map(|node| format!("node {node}")).collect();
        let form = if out.shows_events() {
            Form::Lines(Mutex::new(nodes.iter().map(|node| Lines::new(out, *node)).collect()))
        } else if out.on_terminal() {
            let all = MultiProgress::with_draw_target(ProgressDrawTarget::stdout());
            let bar = |name: &String| {
                let bar = all.add(ProgressBar::new(1)).with_prefix(name.clone());
                bar.set_style(style(STYLE));
                bar.set_message("waiting");
                bar
            };
            Form::Terminal(names.iter().map(bar).collect())
        } else {
            Form::Plain(Mutex::new(vec![0; names.len()]))
        };
        Self { out, nodes: nodes.to_vec(), names, form }
    }

    /// Shows an event of a device.
    pub(super) fn show(&self, device: usize, event: Event) {
        let (Some(name), Some(node)) = (self.names.get(device), self.nodes.get(device)) else { return };
        record::event(*node, &event);
        match (&self.form, event) {
            (Form::Lines(lines), event) => {
                let mut lines = lines.lock().unwrap_or_else(PoisonError::into_inner);
                lines[device].show(&event);
            }
            // The summary shows it.
            (_, Event::Done(_)) => {}
            (Form::Terminal(bars), Event::Progress { done, total }) => {
                bars[device].set_length(total as u64);
                bars[device].set_position(done as u64);
                bars[device].set_message("");
            }
            (Form::Terminal(bars), event) => bars[device].set_message(event.to_string()),
            (Form::Plain(tenths), Event::Progress { done, total }) => {
                let now = (done * 10).checked_div(total).unwrap_or(10);
                // No thread panics while it holds the lock; and if one did, the number stays valid.
                let mut tenths = tenths.lock().unwrap_or_else(PoisonError::into_inner);
                // Many devices give many lines, so a line for each half is enough.
                if now / 5 > tenths[device] / 5 {
                    self.out.say(format_args!("{name}: {:>3} %", now * 10));
                }
                tenths[device] = now;
            }
            (Form::Plain(_), event) => self.out.say(format_args!("{name}: {event}")),
        }
    }

    /// Leaves the bars on the screen.
    pub(super) fn finish(&self) {
        if let Form::Terminal(bars) = &self.form {
            bars.iter().filter(|bar| !bar.is_finished()).for_each(ProgressBar::abandon);
        }
    }
}

/// The result for one device.
pub(super) struct Outcome {
    pub(super) node: Option<NodeId>,
    /// The device's name in the job.
    pub(super) name: String,
    pub(super) image: String,
    pub(super) result: Result<Report, Failure>,
}

impl Outcome {
    pub(super) fn new(
        node: NodeId,
        image: String,
        result: Result<Report, Failed>,
        diagnosis: Option<&Diagnosis>,
    ) -> Self {
        let failure =
            |failed: Failed| Failure::diagnosed_by(failed.error, diagnosis, node).leaving(Some(failed.left));
        let result = result.map_err(failure);
        Self { node: Some(node), name: format!("node {node}"), image, result }
    }
}

/// Observes the bus once for all devices that are silent, as for a single device.
pub(super) fn diagnose_silence(
    session: &mut Session<'_>,
    results: &[Result<Report, Failed>],
) -> Option<Diagnosis> {
    let silent =
        |result: &Result<Report, Failed>| matches!(result, Err(Failed { error: Error::NoAnswer { .. }, .. }));
    if !session.hears_the_bus() || !results.iter().any(silent) {
        return None;
    }
    // If the bus has failed, the first error remains the reason.
    diagnose(session).ok()
}

/// Shows the summary and returns the result of the command.
pub(super) fn summary(out: Output, outcomes: &[Outcome], report: Option<&Path>) -> Result<(), Failure> {
    let failures: Vec<&Failure> =
        outcomes.iter().filter_map(|outcome| outcome.result.as_ref().err()).collect();
    let mut document = document(outcomes);
    out.say("");
    for Outcome { name, result, .. } in outcomes {
        match result {
            Ok(report) => out.say(format_args!("{name}: {report}")),
            Err(failure) => out.say(format_args!("{name}: {}", failure.to_string().trim_end())),
        }
    }
    let all = outcomes.len();
    out.say(format_args!("{} of {all} devices are done", all - failures.len()));
    end(out, &mut document, report, Failure::of_all(&failures, all))
}

/// Writes the results to their file, and prints them: also those that cannot be written.
pub(super) fn end(
    out: Output,
    document: &mut Value,
    report: Option<&Path>,
    result: Result<(), Failure>,
) -> Result<(), Failure> {
    let written = report.map_or(Ok(()), |path| write_report(path, document));
    let written = written.map_err(|failure| failure.within(document));
    out.value(document);
    written.and(result)
}

/// The results of all devices, as JSON.
pub(super) fn document(outcomes: &[Outcome]) -> Value {
    let failed = outcomes.iter().filter(|outcome| outcome.result.is_err()).count();
    let devices: Vec<Value> = outcomes.iter().map(outcome_value).collect();
    json!({ "command": "flash", "devices": devices, "failed": failed })
}

/// Writes the JSON document to a file.
pub(super) fn write_report(path: &Path, document: &Value) -> Result<(), Failure> {
    output_file::spare(path)?;
    let written = record::replace(path, &format!("{document:#}\n"));
    written.map_err(|error| output_file::unwritable(path, &error))
}

/// Keeps what is begun, before the first frame, in the record and in the file for the results.
pub(super) fn begin(devices: &Value, report: Option<&Path>) -> Result<(), Failure> {
    record::begun(devices).map_err(Failure::system)?;
    let document = json!({ "command": "flash", "began": stamp(wall()), "ended": null, "begun": devices });
    report.map_or(Ok(()), |path| write_report(path, &document))
}

fn outcome_value(outcome: &Outcome) -> Value {
    let mut all = json!({
        "node": outcome.node.map(NodeId::get),
        "name": outcome.name,
        "image": outcome.image,
        "ok": outcome.result.is_ok(),
    });
    match &outcome.result {
        Ok(report) => all["report"] = json!(report),
        Err(failure) => all["error"] = failure.value()["error"].clone(),
    }
    all
}
