//! Shows what the tool waits for, on a terminal only.

use std::fmt::Write;
use std::time::Duration;

use coflash_core::update::event::{Event, Phase};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use super::output::Output;
use super::units::rate;

const STYLE: &str = "{spinner} {msg} ({waited})";

/// A style with times and rates in this tool's units. The templates are constants; if one were wrong,
/// another style is shown.
pub(super) fn style(template: &str) -> ProgressStyle {
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    // An error of the drawing code does not stop the command.
    style
        .progress_chars("=> ")
        .with_key("rate", |state: &ProgressState, text: &mut dyn Write| {
            let _ = write!(text, "{}", rate(state.per_sec()));
        })
        .with_key("left", |state: &ProgressState, text: &mut dyn Write| {
            let _ = write!(text, "{:.0} s", state.eta().as_secs_f64());
        })
        .with_key("waited", |state: &ProgressState, text: &mut dyn Write| {
            let _ = write!(text, "{} s", state.elapsed().as_secs());
        })
}

/// The period of the spinner's steps.
const TURN: Duration = Duration::from_millis(120);

/// A spinner that turns until it is dropped.
#[derive(Debug)]
pub(super) struct Waiting(Option<ProgressBar>);

impl Waiting {
    /// Waits for `what`, as in "node 5 answers".
    pub(super) fn new(out: Output, what: impl Into<String>) -> Self {
        Self(out.shows_waiting().then(|| {
            let spinner = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            spinner.set_style(style(STYLE));
            spinner.set_message(format!("waiting until {}", what.into()));
            spinner.enable_steady_tick(TURN);
            spinner
        }))
    }

    /// Runs a function that writes to the terminal while the spinner turns.
    pub(super) fn beside(&self, write: impl FnOnce()) {
        match &self.0 {
            Some(spinner) => spinner.suspend(write),
            None => write(),
        }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        if let Some(spinner) = &self.0 {
            spinner.finish_and_clear();
        }
    }
}

/// What the tool waits for after this event of an update.
pub(super) fn waits_until(event: &Event) -> &'static str {
    match event {
        Event::Phase(Phase::Searching { .. }) => "the bootloader answers (Ctrl-C ends the wait)",
        Event::Phase(Phase::CallingBack) => "the bootloader answers",
        Event::Phase(Phase::Erasing) => "the old program is erased",
        Event::Phase(Phase::TrialStarting | Phase::Starting) => "the program answers",
        Event::Progress { .. } => "the program is checked",
        _ => "the device answers",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The spinner, and the bars of one device and of many.
    #[test]
    fn every_template_is_a_style() {
        for template in [STYLE, super::super::progress::STYLE, super::super::many::STYLE] {
            assert!(ProgressStyle::with_template(template).is_ok(), "{template}");
        }
    }
}
