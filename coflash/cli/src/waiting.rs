//! Shows what the tool waits for, on a terminal only.

use std::time::Duration;

use coflash_core::update::event::{Event, Phase};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use super::output::Output;

const STYLE: &str = "{spinner} {msg} ({waited})";

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
            // The template is a constant. If it were wrong, another style is shown.
            if let Ok(style) = ProgressStyle::with_template(STYLE) {
                spinner.set_style(style.with_key(
                    "waited",
                    |state: &ProgressState, text: &mut dyn std::fmt::Write| {
                        // An error of the drawing code does not stop the command.
                        let _ = write!(text, "{} s", state.elapsed().as_secs());
                    },
                ));
            }
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

    #[test]
    fn it_has_its_style() {
        assert!(ProgressStyle::with_template(STYLE).is_ok());
    }
}
