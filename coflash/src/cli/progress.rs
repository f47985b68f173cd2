//! What a person sees of an update: a bar on a terminal, plain lines elsewhere.

use std::time::{Duration, Instant};

use coflash::update::Event;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

const STYLE: &str = "{bar:40} {percent:>3} %  {bytes} of {total_bytes}, {bytes_per_sec}, {eta} left";

use super::output::Output;

/// Shows the events of an update.
pub(super) struct Progress {
    out: Output,
    form: Form,
}

enum Form {
    /// On a terminal.
    Terminal(Option<ProgressBar>),
    /// In a file or a pipe: a line for each tenth.
    Plain {
        began: Option<Instant>,
        /// How many tenths have been shown.
        tenths: usize,
    },
}

impl Progress {
    pub(super) fn new(out: Output) -> Self {
        let form =
            if out.on_terminal() { Form::Terminal(None) } else { Form::Plain { began: None, tenths: 0 } };
        Self { out, form }
    }

    pub(super) fn show(&mut self, event: Event) {
        match (&mut self.form, event) {
            (Form::Terminal(shown), Event::Progress { done, total }) => {
                let bar = shown.get_or_insert_with(|| bar(total));
                bar.set_position(done as u64);
                if done == total {
                    bar.finish();
                }
            }
            // The command tells the end.
            (_, Event::Done(_)) => {}
            (Form::Terminal(Some(bar)), event) if !bar.is_finished() => bar.println(format!("  {event}")),
            (Form::Plain { began, tenths }, Event::Progress { done, total }) => {
                let began = *began.get_or_insert_with(Instant::now);
                let now = (done * 10).checked_div(total).unwrap_or(10);
                if now > *tenths {
                    *tenths = now;
                    self.out.say(format_args!("  {}", line(done, total, began.elapsed())));
                }
            }
            (_, event) => self.out.say(format_args!("  {event}")),
        }
    }

    /// Leaves the bar where it stands.
    pub(super) fn finish(&mut self) {
        match &self.form {
            Form::Terminal(Some(bar)) if !bar.is_finished() => bar.abandon(),
            _ => {}
        }
    }
}

fn bar(total: usize) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(total as u64), ProgressDrawTarget::stdout());
    match ProgressStyle::with_template(STYLE) {
        Ok(style) => bar.with_style(style.progress_chars("=> ")),
        // The template is a constant; should it ever be wrong, a bar in another style does.
        Err(_) => bar,
    }
}

/// `30 %  1234 of 4100 bytes, 2.5 kB/s, 3 s left`.
fn line(done: usize, total: usize, took: Duration) -> String {
    let percent = (done * 100).checked_div(total).unwrap_or(100);
    let rate = done as f64 / took.as_secs_f64().max(1e-3);
    let left = (total - done) as f64 / rate.max(1.0);
    format!("{percent:>3} %  {done} of {total} bytes, {:.1} kB/s, {left:.0} s left", rate / 1000.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_has_its_style() {
        assert!(ProgressStyle::with_template(STYLE).is_ok());
    }

    #[test]
    fn a_line_has_rate_and_remaining_time() {
        assert_eq!(line(1000, 4000, Duration::from_secs(2)), " 25 %  1000 of 4000 bytes, 0.5 kB/s, 6 s left");
        assert_eq!(line(0, 4000, Duration::ZERO), "  0 %  0 of 4000 bytes, 0.0 kB/s, 4000 s left");
        assert_eq!(line(0, 0, Duration::ZERO), "100 %  0 of 0 bytes, 0.0 kB/s, 0 s left");
    }
}
