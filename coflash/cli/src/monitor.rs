//! `coflash monitor`: shows the bus in words.

use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::Duration;

use canopen::{Frame, NodeId};
use clap::Args;
use coboot_can::candump::Line;
use coboot_can::decode::Decoder;
use serde_json::json;

use super::context::Context;
use super::device::cancelled;
use super::output::Failure;
use super::values::{milliseconds, nodes};

/// Shows the frames on the bus in words.
///
/// It explains SDO, NMT, EMCY, heartbeat and LSS. Ctrl-C ends it.
#[derive(Debug, Args)]
pub(super) struct Monitor {
    /// Show a log of candump -L or --trace instead of the bus.
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,

    /// Show only the frames of these nodes (and those to all nodes), like 1,5,9-12.
    #[arg(long, short = 'N', alias = "node", value_parser = nodes, value_name = "NODES")]
    nodes: Option<Vec<Vec<NodeId>>>,

    /// End after this many frames.
    #[arg(long, value_name = "FRAMES")]
    count: Option<u64>,

    /// End after this many milliseconds.
    #[arg(long = "for", value_name = "MS", value_parser = milliseconds)]
    time: Option<Duration>,
}

impl Monitor {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let mut show =
            Show { monitor: self, context, decoder: Decoder::new(), left: self.count.unwrap_or(u64::MAX) };
        match &self.replay {
            Some(path) => replay(path, &mut show),
            None => self.live(&mut show),
        }
    }

    fn live(&self, show: &mut Show<'_>) -> Result<(), Failure> {
        let cancelled = cancelled()?;
        let mut adapter = show.context.open()?;
        let began = adapter.now();
        while show.left > 0 && !cancelled.load(Ordering::Relaxed) {
            let now = adapter.now().saturating_sub(began);
            let left = self.time.map_or(Duration::MAX, |time| time.saturating_sub(now));
            if left.is_zero() {
                break;
            }
            if let Some(frame) = adapter.receive(left.min(Duration::from_millis(100)))? {
                show.frame(adapter.now().saturating_sub(began), &frame);
            }
        }
        Ok(())
    }
}

fn replay(path: &Path, show: &mut Show<'_>) -> Result<(), Failure> {
    let unreadable = |error: io::Error| match error.kind() {
        io::ErrorKind::InvalidData => Failure::file(path, "it is not a text in UTF-8: store it as UTF-8"),
        _ => Failure::unreadable(path, &error),
    };
    let file = BufReader::new(File::open(path).map_err(unreadable)?);
    let mut first = None;
    for (number, line) in (1..).zip(file.lines()) {
        let line = line.map_err(unreadable)?;
        // Lines may end with CR alone, and a byte order mark may come before the first one.
        for line in line.trim_start_matches('\u{FEFF}').split('\r') {
            let read = Line::parse(line).map_err(|why| Failure::line(path, number, why))?;
            let Some(Line { time, frame, .. }) = read else { continue };
            let first = *first.get_or_insert(time);
            show.frame(time.saturating_sub(first), &frame);
            if show.left == 0 {
                return Ok(());
            }
        }
    }
    Ok(())
}

struct Show<'c> {
    monitor: &'c Monitor,
    context: &'c Context,
    decoder: Decoder,
    /// How many frames remain to be shown.
    left: u64,
}

impl Show<'_> {
    fn frame(&mut self, time: Duration, frame: &Frame) {
        // The decoder must see all frames: a transfer may begin with a frame that is not shown.
        let words = self.decoder.decode(frame);
        if let (Some(nodes), Some(id)) = (&self.monitor.nodes, frame.cob_id()) {
            let node = NodeId::new((id.get() & 0x7F) as u8).filter(|_| (0x080..0x780).contains(&id.get()));
            if node.is_some_and(|node| !nodes.iter().flatten().any(|wanted| *wanted == node)) {
                return;
            }
        }
        let (seconds, frame) = (time.as_secs_f64(), frame.to_string());
        let line = format!("{seconds:>11.6}  {frame:<20}  {words}");
        let read =
            self.context.out.listed(line, || json!({ "time": seconds, "frame": frame, "words": words }));
        self.left = if read { self.left.saturating_sub(1) } else { 0 };
    }
}
