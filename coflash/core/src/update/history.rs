//! What the report of a failed update has: what was tried, which frames decided, what the device answered.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use coboot_can::decode::Decoder;
use coboot_can::redact::Redactor;
use serde::Serialize;

use super::event::Event;
use crate::file::inspect::Date;
use crate::json;

/// The most steps, and the most frames, of a device: a failed request with all of its attempts, and the
/// questions after it.
const MOST_TRIED: usize = 256;
const MOST_FRAMES: usize = 32;

/// What a report says about a failed update. It has no passwords and no programs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct FailedUpdate {
    /// The device.
    #[serde(serialize_with = "json::node")]
    pub node: NodeId,
    /// The steps and repetitions of the update, with their times.
    pub tried: Vec<String>,
    /// The last frames from and to the node, with their times and in words.
    pub frames: Vec<String>,
    /// What the device has answered ([`Error::answers`](crate::Error::answers)).
    pub answers: Vec<String>,
}

/// What the devices of a bus have shown since their last updates.
#[derive(Debug)]
pub struct Histories {
    of: BTreeMap<NodeId, History>,
    redactor: Redactor,
    decoder: Decoder,
}

#[derive(Debug, Default)]
struct History {
    tried: VecDeque<String>,
    frames: VecDeque<String>,
}

impl Default for Histories {
    fn default() -> Self {
        Self { of: BTreeMap::new(), redactor: Redactor::of_contents(), decoder: Decoder::new() }
    }
}

impl Histories {
    /// Remembers a frame of the bus for the node that sends it or for which it is; `time` is since 1970, UTC.
    /// All frames must be passed, in the order of the bus: what follows a password depends on what was before.
    pub fn saw(&mut self, time: Duration, frame: &Frame) {
        let frame = self.redactor.frame(frame);
        let words = self.decoder.decode(&frame);
        let node = match frame.cob_id() {
            Some(CobId::NMT) => frame.exactly().map(|[_, node]: &[u8; 2]| *node),
            Some(id) => Some((id.get() & 0x7F) as u8),
            None => None,
        };
        let Some(node) = node.and_then(NodeId::new) else { return };
        let line = format!("{}  {frame}  {words}", stamp(time));
        push(&mut self.of.entry(node).or_default().frames, line, MOST_FRAMES);
    }

    /// Remembers an event of an update. At the end of one that has failed, this gives what it has shown.
    pub fn record(&mut self, time: Duration, node: NodeId, event: &Event) -> Option<FailedUpdate> {
        match event {
            Event::Progress { .. } => None,
            Event::Done(done) => {
                let History { tried, frames } = self.of.remove(&node).unwrap_or_default();
                let answers = done.error.as_ref()?.answers.clone();
                Some(FailedUpdate { node, tried: tried.into(), frames: frames.into(), answers })
            }
            event => {
                let line = format!("{}  {event}", stamp(time));
                push(&mut self.of.entry(node).or_default().tried, line, MOST_TRIED);
                None
            }
        }
    }
}

/// Adds a line, and forgets the oldest one if there are more than `most`.
fn push(lines: &mut VecDeque<String>, line: String, most: usize) {
    lines.push_back(line);
    if lines.len() > most {
        lines.pop_front();
    }
}

/// A time since 1970, UTC, as `2026-11-22T06:22:31.123Z`.
#[must_use]
pub fn stamp(time: Duration) -> String {
    let date = Date(time.as_secs()).to_string();
    format!("{}.{:03}Z", date.trim_end_matches(" UTC").replace(' ', "T"), time.subsec_millis())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_that_of_iso_8601() {
        assert_eq!(stamp(Duration::from_millis(1_420_070_400_042)), "2015-01-01T00:00:00.042Z");
    }
}
