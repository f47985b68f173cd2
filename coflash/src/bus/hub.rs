//! Several conversations over one adapter at the same time.
//!
//! Each conversation runs in its own thread with a [`Port`] as its adapter and knows nothing of the
//! others. The adapter stays with the hub: when all conversations wait, the hub receives for them,
//! and each conversation continues when it gets a frame or its time is over. No other thread runs
//! at the same time, so the same answers always give the same course of events.

use std::collections::VecDeque;
use std::io;
use std::sync::mpsc::{channel, Receiver, Sender};
use std::thread;
use std::time::Duration;

use canopen::{Frame, NodeId};

use super::adapter::{Adapter, AdapterError};

/// The work of a conversation with its port. [`run`] collects the results.
pub type Conversation<'c, R> = Box<dyn FnOnce(&mut Port) -> R + Send + 'c>;

/// A frame that is still in the adapter may be the one that a conversation waits for. The time of a
/// conversation is therefore over only when the adapter has no frames left, or after this
/// additional time.
const GRACE: Duration = Duration::from_secs(1);

/// A port's message to the hub.
enum Ask {
    Send(usize, Frame),
    Receive { port: usize, until: Duration },
    Gone(usize),
}

/// The hub's message to a port.
struct Answer {
    frame: Result<Option<Frame>, AdapterError>,
    now: Duration,
}

/// A conversation's access to the bus: it receives only the frames that concern its node.
#[derive(Debug)]
pub struct Port {
    number: usize,
    now: Duration,
    asks: Sender<Ask>,
    answers: Receiver<Answer>,
}

impl Port {
    /// The hub outlives its ports. If it does not, the port reports a lost adapter.
    fn hub_is_gone() -> AdapterError {
        let source = io::Error::from(io::ErrorKind::BrokenPipe);
        AdapterError::Lost { adapter: "the hub".to_string(), source }
    }
}

impl Adapter for Port {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        // If the adapter refuses the frame, the next wait reports it.
        self.asks.send(Ask::Send(self.number, *frame)).map_err(|_| Self::hub_is_gone())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now + timeout;
        self.asks.send(Ask::Receive { port: self.number, until }).map_err(|_| Self::hub_is_gone())?;
        let Answer { frame, now } = self.answers.recv().map_err(|_| Self::hub_is_gone())?;
        self.now = now;
        frame
    }

    fn now(&self) -> Duration {
        self.now
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        // If the hub is gone, no receiver is left.
        let _ = self.asks.send(Ask::Gone(self.number));
    }
}

/// The hub's record of a port.
struct Line {
    node: NodeId,
    answers: Sender<Answer>,
    state: State,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    /// The conversation works, and will send its next request.
    Running,
    /// The conversation waits for a frame.
    Waiting {
        until: Duration,
    },
    Gone,
}

/// Runs the conversations, each with one node and at most `at_once` of them at the same time.
/// Returns their results in the order of the conversations.
///
/// # Panics
/// If a conversation panics.
pub fn run<'c, R: Send + 'c>(
    adapter: &mut dyn Adapter,
    conversations: Vec<(NodeId, Conversation<'c, R>)>,
    at_once: usize,
) -> Vec<R> {
    let count = conversations.len();
    let mut waiting: VecDeque<_> = conversations.into_iter().enumerate().collect();
    let (asks, asked) = channel();
    let (done, results) = channel();
    let mut lines: Vec<Option<Line>> = (0..count).map(|_| None).collect();
    thread::scope(|scope| {
        let mut lost = None;
        loop {
            let busy = |line: &Option<Line>| line.as_ref().is_some_and(|line| line.state != State::Gone);
            while lines.iter().filter(|line| busy(line)).count() < at_once.max(1) {
                let Some((number, (node, conversation))) = waiting.pop_front() else { break };
                let (answers, answered) = channel();
                let mut port = Port { number, now: adapter.now(), asks: asks.clone(), answers: answered };
                let done = done.clone();
                lines[number] = Some(Line { node, answers, state: State::Running });
                scope.spawn(move || {
                    let result = conversation(&mut port);
                    let _ = done.send((number, result));
                });
            }
            if !lines.iter().any(busy) {
                break;
            }
            settle(adapter, &asked, &mut lines, &mut lost);
            serve(adapter, &mut lines, &mut lost);
        }
    });
    drop(done);
    let mut results: Vec<(usize, R)> = results.iter().collect();
    results.sort_by_key(|(number, _)| *number);
    results.into_iter().map(|(_, result)| result).collect()
}

/// Reads the ports' requests until all ports wait, then sends their frames in the order of the
/// ports, independent of the threads' timing.
fn settle(
    adapter: &mut dyn Adapter,
    asked: &Receiver<Ask>,
    lines: &mut [Option<Line>],
    lost: &mut Option<AdapterError>,
) {
    let running = |line: &Option<Line>| line.as_ref().is_some_and(|line| line.state == State::Running);
    let mut frames: Vec<(usize, Frame)> = Vec::new();
    while lines.iter().any(running) {
        // The caller holds a sender, and each port reports its end: this loop ends.
        let Ok(ask) = asked.recv() else { return };
        let (port, state) = match ask {
            Ask::Send(port, frame) => {
                frames.push((port, frame));
                continue;
            }
            Ask::Receive { port, until } => (port, State::Waiting { until }),
            Ask::Gone(port) => (port, State::Gone),
        };
        if let Some(line) = &mut lines[port] {
            line.state = state;
        }
    }
    frames.sort_by_key(|(port, _)| *port);
    for (_, frame) in frames {
        if lost.is_none() {
            *lost = adapter.send(&frame).err();
        }
    }
}

/// Waits until at least one conversation can continue, and wakes it.
fn serve(adapter: &mut dyn Adapter, lines: &mut [Option<Line>], lost: &mut Option<AdapterError>) {
    let waiting = |line: &Line| match line.state {
        State::Waiting { until } => Some(until),
        State::Running | State::Gone => None,
    };
    let Some(earliest) = lines.iter().flatten().filter_map(waiting).min() else { return };
    let received = match lost {
        Some(error) => Err(copy(error)),
        None => adapter.receive(earliest.saturating_sub(adapter.now())),
    };
    let now = adapter.now();
    for line in lines.iter_mut().flatten() {
        let Some(until) = waiting(line) else { continue };
        let frame = match &received {
            Ok(Some(frame)) if concerns(frame, line.node) => Ok(Some(*frame)),
            Ok(Some(_)) if until + GRACE > now => continue,
            Ok(None) if until > now => continue,
            Ok(_) => Ok(None),
            Err(error) => Err(copy(error)),
        };
        line.state = State::Running;
        // If the conversation has ended in the meantime, it reports its end itself.
        let _ = line.answers.send(Answer { frame, now });
    }
    if let Err(error) = received {
        lost.get_or_insert(error);
    }
}

/// Whether a frame comes from this node (answer, heartbeat or emergency), or is another client's
/// request to it.
fn concerns(frame: &Frame, node: NodeId) -> bool {
    let from =
        |id: u16| id & 0x7F == u16::from(node.get()) && matches!(id & 0x780, 0x080 | 0x580 | 0x600 | 0x700);
    frame.cob_id().is_some_and(|id| from(id.get()))
}

/// Copies the error, so that each conversation gets it.
fn copy(error: &AdapterError) -> AdapterError {
    let again = |source: &io::Error| match source.raw_os_error() {
        Some(code) => io::Error::from_raw_os_error(code),
        None => io::Error::new(source.kind(), source.to_string()),
    };
    match error {
        AdapterError::Url { url, why } => AdapterError::Url { url: url.clone(), why: why.clone() },
        AdapterError::Unusable { adapter, what, advice, in_use } => AdapterError::Unusable {
            adapter: adapter.clone(),
            what: what.clone(),
            advice: advice.clone(),
            in_use: *in_use,
        },
        AdapterError::Stuck { adapter, health } => {
            AdapterError::Stuck { adapter: adapter.clone(), health: *health }
        }
        AdapterError::Open { adapter, source } => {
            AdapterError::Open { adapter: adapter.clone(), source: again(source) }
        }
        AdapterError::Protocol { adapter, said } => {
            AdapterError::Protocol { adapter: adapter.clone(), said: said.clone() }
        }
        AdapterError::Lost { adapter, source } => {
            AdapterError::Lost { adapter: adapter.clone(), source: again(source) }
        }
        AdapterError::Gateway { adapter, what } => {
            AdapterError::Gateway { adapter: adapter.clone(), what: what.clone() }
        }
    }
}
