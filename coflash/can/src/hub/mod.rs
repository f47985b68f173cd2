//! Several conversations over one adapter at the same time.
//!
//! Each conversation runs in its own thread with a [`Port`] as its adapter and knows nothing of the
//! others. The adapter stays with the hub: when all conversations wait, the hub receives for them,
//! and each conversation continues when it gets a frame or its time is over. No other thread runs
//! at the same time, so the same answers always give the same course of events.
//!
//! Conversations with devices that have a second SDO server can be a `group`: when all of them
//! bring the same data, the hub writes the data to their devices in one download.

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::sync::mpsc::{channel, Receiver, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use canopen::frame::Channel;
use canopen::nmt::parse_boot_up;
use canopen::sdo::client::SERVERS_MAX;
use canopen::{Address, Frame, NodeId};

use self::group::GroupDownloads;
pub use self::line::Options;
use self::line::{Answer, Item, Line, Reply, State};
use self::turns::Turns;
use super::adapter::{Adapter, AdapterError, Delivery, Group};
use super::health::Losses;

mod group;
mod line;
mod turns;

/// A conversation with one node. [`run`] collects the results.
pub struct Conversation<'c, R> {
    /// The node.
    pub node: NodeId,
    /// The COB-IDs for its part in the group, if it can have one. The COB-ID of requests is that of
    /// the whole group.
    pub channel: Option<Channel>,
    /// The work with its port.
    pub act: Act<'c, R>,
}

/// The work of a conversation.
pub type Act<'c, R> = Box<dyn FnOnce(&mut Port) -> R + Send + 'c>;

/// A frame that is still in the adapter may be the one that a conversation waits for. The time of a
/// conversation is therefore over only when the adapter has no frames left, or after this
/// additional time.
const GRACE: Duration = Duration::from_secs(1);

/// A port's message to the hub.
enum Ask {
    Send(usize, Frame),
    Receive { port: usize, until: Duration },
    Deliver { port: usize, item: Item },
    Leave(usize),
    Gone(usize),
}

/// A conversation's access to the bus: it receives the frames that concern its node, and the boot-up
/// messages of nodes that no conversation is with.
#[derive(Debug)]
pub struct Port {
    number: usize,
    channel: Option<Channel>,
    now: Duration,
    asks: Sender<Ask>,
    answers: Receiver<Answer>,
    /// Those of the adapter, at the time of the last answer.
    losses: Arc<Mutex<Losses>>,
}

impl Port {
    /// The hub outlives its ports. If it does not, the port reports a lost adapter.
    fn hub_is_gone() -> AdapterError {
        let source = io::Error::from(io::ErrorKind::BrokenPipe).into();
        AdapterError::Lost { adapter: "the hub".to_string(), source }
    }

    /// Asks the hub, and waits for its answer.
    fn ask(&mut self, ask: Ask) -> Result<Reply, AdapterError> {
        self.asks.send(ask).map_err(|_| Self::hub_is_gone())?;
        let Answer { reply, now } = self.answers.recv().map_err(|_| Self::hub_is_gone())?;
        self.now = now;
        reply
    }
}

impl Adapter for Port {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        // If the adapter refuses the frame, the next wait reports it.
        self.asks.send(Ask::Send(self.number, *frame)).map_err(|_| Self::hub_is_gone())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now + timeout;
        match self.ask(Ask::Receive { port: self.number, until })? {
            Reply::Frame(frame) => Ok(frame),
            Reply::Delivery(_) => Err(Self::hub_is_gone()),
        }
    }

    fn now(&self) -> Duration {
        self.now
    }

    fn losses(&self) -> Losses {
        *self.losses.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn group(&mut self) -> Option<&mut dyn Group> {
        Some(self)
    }
}

impl Group for Port {
    fn channel(&self) -> Option<Channel> {
        self.channel
    }

    fn deliver(&mut self, turn: u32, at: Address, data: &[u8]) -> Result<Delivery, AdapterError> {
        if self.channel.is_none() {
            return Ok(Delivery::Alone);
        }
        let item = Item { turn, at, data: data.to_vec() };
        match self.ask(Ask::Deliver { port: self.number, item })? {
            Reply::Delivery(met) => Ok(met),
            Reply::Frame(_) => Err(Self::hub_is_gone()),
        }
    }

    fn leave(&mut self) {
        if self.channel.take().is_some() {
            // If the hub is gone, the next wait reports it.
            let _ = self.asks.send(Ask::Leave(self.number));
        }
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        // If the hub is gone, no receiver is left.
        let _ = self.asks.send(Ask::Gone(self.number));
    }
}

/// Runs the conversations. Returns their results in the order of the conversations.
///
/// # Panics
/// If a conversation panics.
pub fn run<'c, R: Send + 'c>(
    adapter: &mut dyn Adapter,
    conversations: Vec<Conversation<'c, R>>,
    options: &Options,
) -> Vec<R> {
    let count = conversations.len();
    let nodes: Vec<NodeId> = conversations.iter().map(|conversation| conversation.node).collect();
    let mut downloads = GroupDownloads::new(options);
    let mut turns = Turns::default();
    let mut waiting: VecDeque<_> = conversations.into_iter().enumerate().collect();
    let (asks, asked) = channel();
    let (done, results) = channel();
    let losses = Arc::new(Mutex::new(adapter.losses()));
    let mut lines: Vec<Option<Line>> = (0..count).map(|_| None).collect();
    thread::scope(|scope| {
        let mut lost = None;
        loop {
            let busy = |line: &Option<Line>| line.as_ref().is_some_and(|line| line.state != State::Gone);
            // Who waits for the group has no work.
            let at_work = |line: &&Line| !matches!(line.state, State::InGroup(_) | State::Gone);
            while lines.iter().flatten().filter(at_work).count() < options.at_once.max(1) {
                let Some((number, Conversation { node, channel: part, act })) = waiting.pop_front() else {
                    break;
                };
                let (answers, answered) = channel();
                // More devices than a group has are updated alone.
                let part = part.filter(|_| number < SERVERS_MAX);
                let (now, asks) = (adapter.now(), asks.clone());
                let losses = losses.clone();
                let mut port = Port { number, channel: part, now, asks, answers: answered, losses };
                let done = done.clone();
                lines[number] = Some(Line { node, channel: part, answers, state: State::Running });
                scope.spawn(move || {
                    let result = act(&mut port);
                    let _ = done.send((number, result));
                });
            }
            if !lines.iter().any(busy) {
                break;
            }
            settle(adapter, &asked, &mut lines, &mut turns, &mut lost);
            let is_complete = !waiting.iter().any(|(_, conversation)| conversation.channel.is_some());
            if lost.is_none() {
                lost = downloads.go_on(adapter, &mut lines, is_complete).err();
            }
            serve(adapter, &nodes, &mut lines, &mut downloads, &mut turns, (&mut lost, &losses));
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
    turns: &mut Turns,
    lost: &mut Option<AdapterError>,
) {
    let running = |line: &Option<Line>| line.as_ref().is_some_and(|line| line.state == State::Running);
    let now = adapter.now();
    let mut sent: BTreeMap<usize, Vec<Frame>> = BTreeMap::new();
    let mut waits: BTreeMap<usize, Duration> = BTreeMap::new();
    while lines.iter().any(running) {
        // The caller holds a sender, and each port reports its end: this loop ends.
        let Ok(ask) = asked.recv() else { return };
        let (port, state) = match ask {
            Ask::Send(port, frame) => {
                sent.entry(port).or_default().push(frame);
                continue;
            }
            Ask::Leave(port) => {
                if let Some(line) = &mut lines[port] {
                    line.channel = None;
                }
                continue;
            }
            Ask::Receive { port, until } => {
                waits.insert(port, until);
                (port, State::Waiting { until })
            }
            Ask::Deliver { port, item } => (port, State::InGroup(item)),
            Ask::Gone(port) => {
                turns.gone(port);
                (port, State::Gone)
            }
        };
        if let Some(line) = &mut lines[port] {
            line.state = state;
        }
    }
    let mut frames = Vec::new();
    for (port, until) in &waits {
        frames.extend(turns.take(*port, sent.remove(port).unwrap_or_default(), *until, now));
    }
    // Who does not wait for an answer has ended, or waits for its group.
    frames.extend(sent.into_values().flatten());
    frames.extend(turns.pass_on(now));
    for frame in frames {
        if lost.is_none() {
            *lost = adapter.send(&frame).err();
        }
    }
}

/// Waits until at least one conversation or the group can continue, and wakes it.
fn serve(
    adapter: &mut dyn Adapter,
    nodes: &[NodeId],
    lines: &mut [Option<Line>],
    downloads: &mut GroupDownloads,
    turns: &mut Turns,
    (lost, losses): (&mut Option<AdapterError>, &Mutex<Losses>),
) {
    let waiting = |line: &Line| match line.state {
        State::Waiting { until } => Some(until),
        State::Running | State::InGroup(_) | State::Gone => None,
    };
    if lines.iter().flatten().any(|line| line.state == State::Running) {
        return;
    }
    let in_turn = lines.iter().enumerate().filter(|(port, _)| !turns.hold(*port));
    let deadlines = in_turn.filter_map(|(_, line)| waiting(line.as_ref()?));
    let deadlines = deadlines.chain(downloads.deadline()).chain(turns.deadline());
    let received = match (&*lost, deadlines.min()) {
        (Some(error), _) => Err(error.clone()),
        (None, None) => return,
        (None, Some(earliest)) => adapter.receive(earliest.saturating_sub(adapter.now())),
    };
    let now = adapter.now();
    *losses.lock().unwrap_or_else(PoisonError::into_inner) = adapter.losses();
    if let Ok(Some(frame)) = &received {
        downloads.hear(frame, lines, now);
    }
    for (port, line) in lines.iter_mut().enumerate() {
        let Some(line) = line else { continue };
        let until = match (&line.state, &received) {
            (State::Waiting { until }, _) => *until,
            (State::InGroup(_), Err(error)) => {
                line.wake(Err(error.clone()), now);
                continue;
            }
            _ => continue,
        };
        let frame = match &received {
            Ok(Some(frame)) if concerns(frame, line.node) || is_strangers_boot_up(frame, nodes) => {
                Ok(Some(*frame))
            }
            Ok(Some(_)) if until + GRACE > now => continue,
            Ok(None) if until > now => continue,
            // Its frames are not sent yet, so its time has not begun.
            Ok(_) if turns.hold(port) => continue,
            Ok(_) => Ok(None),
            Err(error) => Err(error.clone()),
        };
        turns.woken(port, now);
        line.wake(frame.map(Reply::Frame), now);
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

/// Whether a node has booted up that no conversation is with: it may be one of their devices, under
/// another node-ID.
fn is_strangers_boot_up(frame: &Frame, nodes: &[NodeId]) -> bool {
    parse_boot_up(frame).is_some_and(|node| !nodes.contains(&node))
}
