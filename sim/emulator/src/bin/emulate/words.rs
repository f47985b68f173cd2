//! The events on the bus as sentences for people to read. Only notable events are reported: a node
//! starts, changes its state or has an emergency, or frames do not get through. The meanings are
//! those of CiA 301 (7.2.5 and 7.3.5).

use std::collections::BTreeMap;

use emulator::bus::{Outcome, Record};

/// Remembers the states that it has reported, so that it reports each once.
#[derive(Default)]
pub struct Words {
    /// The NMT state that each node last reported.
    states: BTreeMap<u32, u8>,
    /// Frames in a row that failed.
    failures: u64,
}

/// A heartbeat's state byte; the toggle bit of node guarding is not part of it.
fn state(byte: u8) -> Option<&'static str> {
    Some(match byte {
        0 => "boot-up",
        4 => "stopped",
        5 => "operational",
        127 => "pre-operational",
        _ => return None,
    })
}

fn command(byte: u8) -> Option<&'static str> {
    Some(match byte {
        1 => "start",
        2 => "stop",
        128 => "enter pre-operational",
        129 => "reset node",
        130 => "reset communication",
        _ => return None,
    })
}

impl Words {
    /// A sentence about the frame, if it is worth one.
    pub fn of(&mut self, record: &Record) -> Option<String> {
        if let Outcome::Bad(kind) = record.outcome {
            self.failures += 1;
            return (self.failures == 1)
                .then(|| format!("{} does not get through: {}; it is repeated", record.frame, kind.words()));
        }
        let after = match std::mem::take(&mut self.failures) {
            0 | 1 => String::new(),
            failures => format!(" (after {failures} failures)"),
        };
        let text = self.meaning(record);
        match (text, after.is_empty()) {
            (Some(text), _) => Some(text + &after),
            (None, false) => Some(format!("{} got through{after}", record.frame)),
            (None, true) => None,
        }
    }

    fn meaning(&mut self, record: &Record) -> Option<String> {
        let frame = &record.frame;
        if frame.is_extended() || frame.is_remote() {
            return None;
        }
        match (frame.raw_id(), frame.data()) {
            (0x000, [byte, node]) => {
                let to = if *node == 0 { "all nodes".into() } else { format!("node {node}") };
                Some(format!("NMT: {} to {to}", command(*byte)?))
            }
            (id @ 0x081..=0x0FF, [low, high, register, ..]) => {
                let code = u16::from_le_bytes([*low, *high]);
                Some(format!("node {}: emergency {code:04X}h, error register {register:02X}h", id - 0x080))
            }
            (id @ 0x701..=0x77F, [byte]) => {
                let node = id - 0x700;
                let now = byte & 0x7F;
                let before = self.states.insert(node, now);
                let name = state(now)?;
                (before != Some(now) || now == 0).then(|| match now {
                    0 => format!("node {node}: {name}"),
                    _ => format!("node {node}: heartbeat, {name}"),
                })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emulator::bus::node::ErrorKind;
    use emulator::frame::Frame;
    use emulator::time::Time;

    fn say(words: &mut Words, id: u16, data: &[u8], outcome: Outcome) -> String {
        let frame = Frame::standard(id, data).unwrap();
        let record = Record { start: Time(0), end: Time(0), frame, from: None, readers: 0, outcome };
        words.of(&record).unwrap_or_default()
    }

    #[test]
    fn frames_in_words() {
        let mut words = Words::default();
        let mut good = |id, data: &[u8]| say(&mut words, id, data, Outcome::Good);
        assert_eq!(good(0x701, &[0]), "node 1: boot-up");
        assert_eq!(good(0x701, &[127]), "node 1: heartbeat, pre-operational");
        assert_eq!(good(0x701, &[127]), "", "said before");
        assert_eq!(good(0x77F, &[127]), "node 127: heartbeat, pre-operational");
        assert_eq!(good(0x701, &[0]), "node 1: boot-up");
        assert_eq!(good(0x701, &[0]), "node 1: boot-up", "each boot-up counts");
        assert_eq!(good(0x000, &[129, 5]), "NMT: reset node to node 5");
        assert_eq!(good(0x000, &[1, 0]), "NMT: start to all nodes");
        assert_eq!(
            good(0x085, &[0x10, 0x81, 0x11, 0, 0, 0, 0, 0]),
            "node 5: emergency 8110h, error register 11h"
        );
        for (id, data) in
            [(0x601, &[0x40][..]), (0x080, &[]), (0x701, &[]), (0x701, &[9]), (0, &[7, 0]), (0x081, &[1])]
        {
            assert_eq!(good(id, data), "", "{id:x}");
        }
    }

    #[test]
    fn failures_are_said_once() {
        let mut words = Words::default();
        let bad = Outcome::Bad(ErrorKind::Acknowledge);
        assert_eq!(
            say(&mut words, 0x701, &[0], bad),
            "701#00 does not get through: no acknowledge; it is repeated"
        );
        assert_eq!(say(&mut words, 0x701, &[0], bad), "");
        assert_eq!(say(&mut words, 0x701, &[0], Outcome::Good), "node 1: boot-up (after 2 failures)");
        assert_eq!(
            say(&mut words, 0x601, &[], bad),
            "601# does not get through: no acknowledge; it is repeated"
        );
        assert_eq!(say(&mut words, 0x601, &[], bad), "");
        assert_eq!(say(&mut words, 0x601, &[], Outcome::Good), "601# got through (after 2 failures)");
        assert_eq!(say(&mut words, 0x601, &[], Outcome::Good), "");
    }
}
