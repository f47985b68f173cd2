//! The output of an update: a bar on a terminal, plain lines elsewhere, one JSON object on each
//! line for programs.

use std::time::Instant;

use canopen::NodeId;
use coflash_core::update::Event;
use indicatif::{ProgressBar, ProgressDrawTarget};

use super::output::Output;
use super::units::Pace;
use super::waiting::{style, waits_until, Waiting};
use super::{events, record};

pub(super) const STYLE: &str = "{bar:40} {percent:>3} %  {pos} of {len} bytes, {rate}, {left} left";

/// Shows the events of an update.
pub(super) struct Progress {
    out: Output,
    node: NodeId,
    form: Form,
}

enum Form {
    /// On a terminal: a bar during the download, and a message before and after it.
    Terminal { bar: Option<ProgressBar>, waiting: Option<Waiting> },
    /// In a file or a pipe: a line for each tenth.
    Plain {
        began: Option<Instant>,
        /// How many tenths have been shown.
        tenths: usize,
    },
    /// The output for programs.
    Lines(events::Lines),
}

impl Progress {
    pub(super) fn new(out: Output, node: NodeId) -> Self {
        let form = if out.shows_events() {
            Form::Lines(events::Lines::new(out, node))
        } else if out.on_terminal() {
            let waiting = Some(Waiting::new(out, format!("node {node} answers")));
            Form::Terminal { bar: None, waiting }
        } else {
            Form::Plain { began: None, tenths: 0 }
        };
        Self { out, node, form }
    }

    pub(super) fn show(&mut self, event: Event) {
        record::event(self.node, &event);
        match (&mut self.form, event) {
            (Form::Lines(lines), event) => lines.show(&event),
            (Form::Terminal { bar, waiting }, Event::Progress { done, total }) => {
                let shown = bar.get_or_insert_with(|| new_bar(total));
                // More than one event reports the end.
                if shown.is_finished() {
                    return;
                }
                *waiting = None;
                shown.set_position(done as u64);
                if done == total {
                    shown.finish();
                    *waiting = Some(Waiting::new(self.out, waits_until(&Event::Progress { done, total })));
                }
            }
            // The command reports the end.
            (Form::Terminal { waiting, .. }, Event::Done(_)) => *waiting = None,
            (Form::Plain { .. }, Event::Done(_)) => {}
            (Form::Terminal { bar: Some(bar), .. }, event) if !bar.is_finished() => {
                bar.println(format!("  {event}"));
            }
            (Form::Terminal { waiting, .. }, event) => {
                *waiting = None;
                self.out.say(format_args!("  {event}"));
                *waiting = Some(Waiting::new(self.out, waits_until(&event)));
            }
            (Form::Plain { began, tenths }, Event::Progress { done, total }) => {
                let began = *began.get_or_insert_with(Instant::now);
                let now = (done * 10).checked_div(total).unwrap_or(10);
                if now > *tenths {
                    *tenths = now;
                    self.out.say(format_args!("  {}", Pace::new(done, total, began.elapsed())));
                }
            }
            (Form::Plain { .. }, event) => self.out.say(format_args!("  {event}")),
        }
    }

    /// Leaves the bar on the screen.
    pub(super) fn finish(&mut self) {
        if let Form::Terminal { bar, waiting } = &mut self.form {
            *waiting = None;
            if let Some(bar) = bar.as_ref().filter(|bar| !bar.is_finished()) {
                bar.abandon();
            }
        }
    }
}

fn new_bar(total: usize) -> ProgressBar {
    ProgressBar::with_draw_target(Some(total as u64), ProgressDrawTarget::stdout()).with_style(style(STYLE))
}
