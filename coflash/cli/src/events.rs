//! `--json-events`: reports events as they happen, one JSON object on each line.
//!
//! Each line has `event`: the library's events of an update (`found`, `phase`, `progress`, `retry`,
//! `note`, `warning`, `done`), `result` for the result of a command, and `error`.

use std::time::Instant;

use canopen::NodeId;
use coflash_core::update::Event;
use serde_json::json;

use super::output::Output;
use super::units::Pace;

/// The lines of one device.
#[derive(Debug)]
pub(super) struct Lines {
    out: Output,
    node: NodeId,
    began: Option<Instant>,
    /// The percentage that was shown last.
    percent: Option<usize>,
}

impl Lines {
    pub(super) fn new(out: Output, node: NodeId) -> Self {
        Self { out, node, began: None, percent: None }
    }

    /// Writes one line. For progress, writes one line for each percent, with rate and remaining
    /// time.
    pub(super) fn show(&mut self, event: &Event) {
        let mut line = match serde_json::to_value(event.line(self.node)) {
            Ok(line) => line,
            // JSON can represent every event, so this arm is not reached.
            Err(_) => json!({ "node": self.node.get(), "text": event.to_string() }),
        };
        if let Event::Progress { done, total } = *event {
            let began = *self.began.get_or_insert_with(Instant::now);
            let pace = Pace::new(done, total, began.elapsed());
            if self.percent == Some(pace.percent()) {
                return;
            }
            self.percent = Some(pace.percent());
            line["bytes_per_second"] = (pace.rate.round() as u64).into();
            // Before the first byte the rate is unknown.
            let left = (done > 0).then(|| (pace.left * 10.0).round() / 10.0);
            line["seconds_left"] = left.into();
        }
        self.out.event(&line);
    }
}
