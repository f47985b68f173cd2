//! What the hub keeps of each conversation, and what it answers.

use std::sync::atomic::AtomicBool;
use std::sync::mpsc::Sender;
use std::sync::Arc;
use std::time::Duration;

use canopen::frame::Channel;
use canopen::{Address, Frame, NodeId};

use crate::adapter::{AdapterError, Delivery};

/// How conversations run.
#[derive(Clone, Debug)]
pub struct Options {
    /// How many are at work at the same time.
    pub at_once: usize,
    /// How long the group waits for the answer of a device.
    pub answer: Duration,
    /// Ends a download of the group when it is set.
    pub cancelled: Arc<AtomicBool>,
}

/// The hub's message to a port.
pub(super) struct Answer {
    pub(super) reply: Result<Reply, AdapterError>,
    pub(super) now: Duration,
}

pub(super) enum Reply {
    Frame(Option<Frame>),
    Delivery(Delivery),
}

/// What a conversation brings to a download of its group.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct Item {
    pub(super) turn: u32,
    pub(super) at: Address,
    pub(super) data: Vec<u8>,
}

/// The hub's record of a port.
pub(super) struct Line {
    pub(super) node: NodeId,
    /// Its part in the group, until it leaves.
    pub(super) channel: Option<Channel>,
    pub(super) answers: Sender<Answer>,
    pub(super) state: State,
}

impl Line {
    /// Lets the conversation continue.
    pub(super) fn wake(&mut self, reply: Result<Reply, AdapterError>, now: Duration) {
        self.state = State::Running;
        // If the conversation has ended in the meantime, it reports its end itself.
        let _ = self.answers.send(Answer { reply, now });
    }
}

#[derive(Clone, PartialEq, Eq)]
pub(super) enum State {
    /// The conversation works, and will send its next request.
    Running,
    /// The conversation waits for a frame.
    Waiting {
        until: Duration,
    },
    /// The conversation waits for the others of its group.
    InGroup(Item),
    Gone,
}
