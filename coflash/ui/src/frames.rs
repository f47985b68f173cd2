//! The frames of the bus: stored for the page, counted for the plot, and saved as a log.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use canopen::{Frame, NodeId};
use coflash_core::update::{Event, FailedUpdate, Histories};
use serde::Serialize;
use tokio::sync::watch;

use super::load;
use coboot_can::candump::Line;
use coboot_can::decode::Decoder;
use coboot_can::redact::Redactor;
use coboot_can::{wall, Adapter, Tap};

/// The most frames in words that the page can request.
const ROWS: usize = 2000;
/// The most frames in the log: twice the segmented transfer of a megabyte. They take 16 MB.
pub(super) const TRACE: usize = 400_000;
/// The seconds of the plot.
const SECONDS: usize = 600;

/// A frame in the form for the page.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Row {
    /// The frame's number since the start.
    pub(super) number: u64,
    /// Seconds since 1970, UTC.
    time: f64,
    /// Whether this tool sent the frame.
    own: bool,
    frame: String,
    words: String,
}

/// The traffic of the bus within one second.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct Second {
    /// The second, counted from 1970.
    pub(super) second: u64,
    frames: u32,
    /// Bits on the wire.
    bits: u32,
}

/// All recorded frames. The size is limited: the oldest are dropped first.
#[derive(Debug, Default)]
pub(super) struct Frames {
    rows: VecDeque<Row>,
    trace: VecDeque<(Duration, Frame)>,
    /// The number of frames that were dropped from the log.
    forgotten: u64,
    seconds: VecDeque<Second>,
    decoder: Decoder,
    histories: Histories,
    /// Passwords are on the bus, and not on the page or in its log.
    redactor: Redactor,
    count: u64,
}

impl Frames {
    fn note(&mut self, time: Duration, frame: &Frame, own: bool) {
        self.count += 1;
        self.histories.saw(time, frame);
        let seen = self.redactor.frame(frame);
        let words = self.decoder.decode(&seen);
        let (number, shown) = (self.count, seen.to_string());
        push(&mut self.rows, ROWS, Row { number, time: time.as_secs_f64(), own, frame: shown, words });
        self.forgotten += u64::from(push(&mut self.trace, TRACE, (time, seen)));
        let second = time.as_secs();
        if self.seconds.back().is_none_or(|last| last.second < second) {
            push(&mut self.seconds, SECONDS, Second { second, ..Second::default() });
        }
        if let Some(last) = self.seconds.back_mut() {
            last.frames += 1;
            last.bits += load::bits(frame);
        }
    }

    /// Remembers an event of an update; gives what the device has shown if its update has failed.
    pub(super) fn record(&mut self, node: NodeId, event: &Event) -> Option<FailedUpdate> {
        self.histories.record(wall(), node, event)
    }

    /// The frames after this one, oldest first.
    pub(super) fn rows_after(&self, number: u64) -> Vec<Row> {
        let fresh = self.rows.iter().rev().take_while(|row| row.number > number).count();
        self.rows.iter().skip(self.rows.len() - fresh).cloned().collect()
    }

    /// The number of frames so far.
    pub(super) fn count(&self) -> u64 {
        self.count
    }

    /// The complete seconds after this one.
    pub(super) fn seconds_after(&self, second: u64, now: u64) -> Vec<Second> {
        self.seconds.iter().filter(|past| past.second > second && past.second < now).copied().collect()
    }

    /// The log, and the number of frames that are missing at its beginning.
    pub(super) fn log(&self) -> (VecDeque<(Duration, Frame)>, u64) {
        (self.trace.clone(), self.forgotten)
    }
}

/// The log as text in the format of `candump -L`.
pub(super) fn candump(log: &VecDeque<(Duration, Frame)>, forgotten: u64) -> String {
    let mut text = String::with_capacity(log.len() * 56);
    if forgotten > 0 {
        text += &format!("# {forgotten} earlier frames were dropped: the log is full\n");
    }
    for (time, frame) in log {
        let line = Line { time: *time, interface: "can0".to_string(), frame: *frame };
        text += &format!("{line}\n");
    }
    text
}

/// Appends an item; returns whether the oldest one was dropped.
fn push<T>(queue: &mut VecDeque<T>, room: usize, item: T) -> bool {
    let full = queue.len() >= room;
    if full {
        queue.pop_front();
    }
    queue.push_back(item);
    full
}

/// An adapter that records its frames, sent and received.
pub(super) fn recorded(
    adapter: Box<dyn Adapter + Send>,
    frames: Arc<Mutex<Frames>>,
    arrived: watch::Sender<u64>,
) -> Tap<Box<dyn Adapter + Send>> {
    let ear = move |time: Duration, frame: &Frame, own: bool| {
        let mut frames = frames.lock().unwrap_or_else(PoisonError::into_inner);
        frames.note(time, frame, own);
        arrived.send_replace(frames.count);
    };
    Tap::new(adapter, Box::new(ear))
}

#[cfg(test)]
mod tests {
    use embedded_can::{Frame as _, StandardId};

    use super::*;

    fn frame() -> Frame {
        Frame::new(StandardId::new(0x701).unwrap(), &[5]).unwrap()
    }

    #[test]
    fn memory_is_limited_and_what_is_missing_is_counted() {
        let mut frames = Frames::default();
        for number in 0..(TRACE as u64 + 7) {
            frames.note(Duration::from_millis(number * 100), &frame(), false);
        }
        assert_eq!(frames.rows_after(0).len(), ROWS);
        assert_eq!(frames.seconds_after(0, u64::MAX).len(), SECONDS);
        let (log, forgotten) = frames.log();
        assert_eq!((log.len(), forgotten), (TRACE, 7));
        assert_eq!(frames.count(), TRACE as u64 + 7);
    }

    #[test]
    fn a_page_gets_what_it_has_not_and_whole_seconds() {
        let mut frames = Frames::default();
        for millis in [100, 200, 1100, 2100] {
            frames.note(Duration::from_millis(millis), &frame(), true);
        }
        let numbers = |after| frames.rows_after(after).iter().map(|row| row.number).collect::<Vec<_>>();
        assert_eq!(numbers(0), [1, 2, 3, 4]);
        assert_eq!(numbers(2), [3, 4]);
        assert!(numbers(4).is_empty() && numbers(99).is_empty());
        let seconds = |after, now| {
            frames.seconds_after(after, now).iter().map(|past| (past.second, past.frames)).collect::<Vec<_>>()
        };
        assert_eq!(seconds(0, 2), [(1, 1)]);
        assert_eq!(seconds(0, 3), [(1, 1), (2, 1)]);
    }

    /// 6005h/1 by segments: "Si8K" of a password, and a number into 7F50h/1.
    #[test]
    fn a_password_is_neither_on_the_page_nor_in_the_log() {
        let mut frames = Frames::default();
        for data in [
            // The end of one that began before the page was there.
            [0x07, b'S', b'i', b'8', b'K', 0, 0, 0],
            [0x21, 0x05, 0x60, 1, 4, 0, 0, 0],
            [0x07, b'S', b'i', b'8', b'K', 0, 0, 0],
            [0x23, 0x50, 0x7F, 1, b'T', b'I', b'N', b'I'],
        ] {
            let frame = Frame::new(StandardId::new(0x605).unwrap(), &data).unwrap();
            frames.note(Duration::ZERO, &frame, true);
        }
        let rows = serde_json::to_string(&frames.rows_after(0)).unwrap();
        let shown = rows + &candump(&frames.log().0, 0);
        for secret in ["53 69 38 4B", "5369384B", "Si8K", "54 49 4E 49", "54494E49", "TINI", "494E4954"] {
            assert!(!shown.contains(secret), "{secret}: {shown}");
        }
    }

    #[test]
    fn the_log_is_that_of_candump() {
        let mut frames = Frames::default();
        frames.note(Duration::new(1_436_509_052, 249_713_000), &frame(), false);
        let (log, _) = frames.log();
        assert_eq!(candump(&log, 0), "(1436509052.249713) can0 701#05\n");
        assert!(candump(&log, 3).starts_with("# 3 earlier frames"));
    }
}
