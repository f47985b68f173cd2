//! `--json-events`: what happens, as it happens, one JSON object a line.
//!
//! Each line has `event`: those of an update as the library names them (`found`, `phase`, `progress`,
//! `retry`, `note`, `warning`, `done`), `result` for what a command came to, and `error`.

use std::time::Instant;

use canopen::NodeId;
use coflash::update::Event;
use serde_json::json;

use super::output::Output;
use super::units::Pace;

/// The lines of one device.
#[derive(Debug)]
pub(super) struct Lines {
    out: Output,
    node: NodeId,
    began: Option<Instant>,
    /// What was shown last, in percent.
    percent: Option<usize>,
}

impl Lines {
    pub(super) fn new(out: Output, node: NodeId) -> Self {
        Self { out, node, began: None, percent: None }
    }

    /// One line; of progress one for each percent, with rate and remaining time.
    pub(super) fn show(&mut self, event: &Event) {
        let mut line = match serde_json::to_value(event.line(self.node)) {
            Ok(line) => line,
            // Events have nothing that JSON has not.
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
            // Before the first byte nothing is known of the rate.
            let left = (done > 0).then(|| (pace.left * 10.0).round() / 10.0);
            line["seconds_left"] = left.into();
        }
        self.out.event(&line);
    }
}
