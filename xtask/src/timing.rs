//! Timing diagrams of the pages, drawn from text: the messages on the bus, and the work meanwhile.
//!
//! A line is one of these; a line that starts with `#` is a remark. Times are in milliseconds.
//!
//! ```text
//! panel TITLE                        another diagram below the last one
//! span FROM TO                       its time axis
//! frame FROM TO WORDS                a message on the bus
//! bar LANE FROM TO COLOUR WORDS      what goes on in a lane; " / " breaks the words
//! mark AT WORDS                      a moment
//! ```

use std::fmt::Write;

use crate::Outcome;

/// An event with a duration.
struct Bar<'t> {
    from: f64,
    to: f64,
    colour: &'t str,
    words: &'t str,
}

struct Panel<'t> {
    title: &'t str,
    from: f64,
    to: f64,
    frames: Vec<Bar<'t>>,
    /// The lanes by name, in the order of their first appearance.
    lanes: Vec<(&'t str, Vec<Bar<'t>>)>,
    marks: Vec<(f64, &'t str)>,
}

/// Sizes in pixels.
const NAMES: f64 = 96.0;
const AXIS: f64 = 640.0;
const WIDTH: f64 = NAMES + AXIS + 24.0;
const ROW: f64 = 20.0;
const LANE: f64 = 44.0;
/// Width of a letter of 12 pixels, at most.
const LETTER: f64 = 6.6;

/// Draws the text.
///
/// # Errors
/// When a line is not one of the above; the message names it.
pub fn drawn(text: &str) -> Outcome<String> {
    let mut svg = String::new();
    let mut top = 8.0;
    for panel in panels(text)? {
        top = panel.draw(&mut svg, top);
    }
    Ok(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{top}\" viewBox=\"0 0 {WIDTH} {top}\" \
         font-family=\"Helvetica,Arial,sans-serif\" font-size=\"12\">\n\
         <rect width=\"{WIDTH}\" height=\"{top}\" fill=\"white\"/>\n{svg}</svg>\n"
    ))
}

fn panels(text: &str) -> Outcome<Vec<Panel<'_>>> {
    let mut panels: Vec<Panel<'_>> = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (kind, rest) = line.split_once(' ').unwrap_or((line, ""));
        let understood = match (kind, panels.last_mut()) {
            ("panel", _) => {
                let (frames, lanes, marks) = (Vec::new(), Vec::new(), Vec::new());
                panels.push(Panel { title: rest, from: 0.0, to: 1.0, frames, lanes, marks });
                Some(())
            }
            (_, Some(panel)) => panel.take(kind, rest),
            (_, None) => None,
        };
        understood.ok_or_else(|| format!("line {number} of the diagram is not understood: {line}"))?;
    }
    Ok(panels)
}

/// The next word of a line as a time.
fn time(line: &str) -> Option<(f64, &str)> {
    let (word, rest) = line.split_once(' ').unwrap_or((line, ""));
    Some((word.parse().ok().filter(|time: &f64| time.is_finite())?, rest))
}

impl<'t> Panel<'t> {
    /// Takes a line; `None` if it is invalid.
    fn take(&mut self, kind: &str, line: &'t str) -> Option<()> {
        match kind {
            "span" => {
                let (from, line) = time(line)?;
                let (to, line) = time(line)?;
                (self.from, self.to) = (from, to);
                (line.is_empty() && from < to).then_some(())
            }
            "frame" => {
                let (from, line) = time(line)?;
                let (to, words) = time(line)?;
                self.frames.push(Bar { from, to, colour: "#4b5563", words });
                (from < to).then_some(())
            }
            "bar" => {
                let (lane, line) = line.split_once(' ')?;
                let (from, line) = time(line)?;
                let (to, line) = time(line)?;
                let (colour, words) = line.split_once(' ').filter(|(colour, _)| colour.starts_with('#'))?;
                let bar = Bar { from, to, colour, words };
                match self.lanes.iter_mut().find(|(name, _)| *name == lane) {
                    Some((_, bars)) => bars.push(bar),
                    None => self.lanes.push((lane, vec![bar])),
                }
                (from < to).then_some(())
            }
            "mark" => {
                let (at, words) = time(line)?;
                self.marks.push((at, words));
                Some(())
            }
            _ => None,
        }
    }

    /// The position of a time on the axis.
    fn x(&self, time: f64) -> f64 {
        round(NAMES + (time - self.from) / (self.to - self.from) * AXIS)
    }

    /// Draws from `top` on, and returns the position for the next diagram.
    fn draw(&self, svg: &mut String, top: f64) -> f64 {
        words(svg, 8.0, top + 16.0, "font-weight=\"bold\" font-size=\"13\"", self.title);
        // Words that would run into the next frame's are in a row above, where no line crosses
        // them.
        let mut placed: Vec<(f64, usize)> = Vec::new();
        for frame in self.frames.iter().rev() {
            let x = self.x(frame.from);
            let end = x + LETTER * (frame.words.chars().count() as f64 + 1.0);
            let below = placed.iter().filter(|(next, _)| *next <= end).map(|(_, row)| row + 1).max();
            placed.push((x, below.unwrap_or(0)));
        }
        let rows = placed.iter().map(|(_, row)| row + 1).max().unwrap_or(0);
        let bus = top + 28.0 + ROW * rows as f64;
        let bottom = bus + 28.0 + LANE * self.lanes.len() as f64;
        words(svg, 8.0, bus + 15.0, "", "bus");
        line(svg, (NAMES, bus + 20.0), (NAMES + AXIS, bus + 20.0), "#9ca3af");
        for (frame, (x, row)) in self.frames.iter().rev().zip(placed) {
            let baseline = bus - ROW * row as f64 - 6.0;
            line(svg, (x, baseline + 3.0), (x, bus + 20.0), "#9ca3af");
            rectangle(svg, (x, bus + 4.0), (round(self.x(frame.to) - x), 16.0), frame.colour);
            words(svg, x, baseline, "", frame.words);
        }
        for (at, (name, bars)) in self.lanes.iter().enumerate() {
            let y = bus + 28.0 + LANE * at as f64;
            words(svg, 8.0, y + 24.0, "", name);
            for bar in bars {
                let (x, width) = (self.x(bar.from), round(self.x(bar.to) - self.x(bar.from)));
                rectangle(svg, (x, y), (width, LANE - 6.0), bar.colour);
                let lines: Vec<_> = bar.words.split(" / ").collect();
                for (number, line) in lines.iter().enumerate() {
                    let down = 24.0 + 15.0 * number as f64 - 7.0 * (lines.len() - 1) as f64;
                    words(svg, round(x + width / 2.0), y + down, "text-anchor=\"middle\"", line);
                }
            }
        }
        for (at, what) in &self.marks {
            let x = self.x(*at);
            line(svg, (x, bus), (x, bottom + 4.0), "#b91c1c");
            words(svg, x + 4.0, bottom + 10.0, "fill=\"#b91c1c\"", what);
        }
        let mut time = (self.from / 5.0).ceil() * 5.0 + 0.0;
        line(svg, (NAMES, bottom + 18.0), (NAMES + AXIS, bottom + 18.0), "#4b5563");
        while time <= self.to {
            line(svg, (self.x(time), bottom + 18.0), (self.x(time), bottom + 23.0), "#4b5563");
            words(svg, self.x(time), bottom + 36.0, "text-anchor=\"middle\"", &format!("{time} ms"));
            time += 5.0;
        }
        bottom + 56.0
    }
}

/// Rounds to a tenth of a pixel, so that the text of the picture is short and the same on every
/// machine.
fn round(value: f64) -> f64 {
    (value * 10.0).round() / 10.0
}

// Writing to a string cannot fail.

fn words(svg: &mut String, x: f64, y: f64, how: &str, words: &str) {
    let words = words.replace('&', "&amp;").replace('<', "&lt;");
    let _ = writeln!(svg, r#"<text x="{x}" y="{y}" {how}>{words}</text>"#);
}

fn line(svg: &mut String, (x1, y1): (f64, f64), (x2, y2): (f64, f64), colour: &str) {
    let _ = writeln!(svg, r#"<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" stroke="{colour}"/>"#);
}

fn rectangle(svg: &mut String, (x, y): (f64, f64), (width, height): (f64, f64), colour: &str) {
    let _ = writeln!(
        svg,
        r##"<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="3" fill="{colour}" stroke="#4b5563"/>"##
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 640 pixels for 20 ms behind 96 pixels of names: 32 pixels a millisecond.
    #[test]
    fn times_become_places() {
        let text = "panel A & B\nspan 0 20\nframe 1 2 x\nbar cpu 5 7.5 #fff a / b\nmark 10 now\n";
        let svg = drawn(text).unwrap();
        for part in [
            "A &amp; B</text>",
            r##"<rect x="128" y="60" width="32" height="16" rx="3" fill="#4b5563""##,
            r##"<rect x="256" y="84" width="80" height="38" rx="3" fill="#fff""##,
            r#"<line x1="416" y1="56""#,
            r#"<text x="296" y="101" text-anchor="middle">a</text>"#,
            r#"<text x="296" y="116" text-anchor="middle">b</text>"#,
        ] {
            assert!(svg.contains(part), "{part}\n{svg}");
        }
    }

    /// Words of 20 letters take more than the 32 pixels to the next frame.
    #[test]
    fn words_of_frames_that_are_close_stand_above_each_other() {
        let svg = drawn("panel A\nspan 0 20\nframe 1 2 twenty letters, each\nframe 2 3 next\n").unwrap();
        let row = |words: &str| {
            let (before, _) = svg.split_once(&format!(" >{words}<")).unwrap();
            before.rsplit_once("y=\"").unwrap().1.trim_end_matches('"').parse::<f64>().unwrap()
        };
        assert_eq!(row("next") - row("twenty letters, each"), ROW);
    }

    #[test]
    fn what_is_not_understood_is_named() {
        for wrong in
            ["frame 1 2 x", "panel A\nbar cpu 1 2 red x", "panel A\nspan 2 1", "panel A\nframe 1 x y"]
        {
            let problem = drawn(wrong).unwrap_err();
            assert!(problem.starts_with(&format!("line {} of", wrong.lines().count())), "{problem}");
        }
    }
}
