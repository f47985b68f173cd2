//! Frames of the tool itself that come back: an adapter or a server may return what it was sent.

use std::collections::VecDeque;

use canopen::Frame;

/// The last `MOST` frames that were sent and did not come back yet, in their order.
#[derive(Debug, Default)]
pub struct Echoes<const MOST: usize>(VecDeque<Frame>);

impl<const MOST: usize> Echoes<MOST> {
    /// A frame was sent.
    pub fn sent(&mut self, frame: &Frame) {
        if self.0.len() == MOST {
            self.0.pop_front();
        }
        self.0.push_back(*frame);
    }

    /// Whether a received frame is the echo of one that was sent, and not another node's. Who returns
    /// frames returns all of them, in their order.
    pub fn takes(&mut self, frame: &Frame) -> bool {
        let at = self.0.iter().position(|sent| sent == frame);
        if let Some(at) = at {
            self.0.drain(..=at);
        }
        at.is_some()
    }

    /// No more echoes of these frames will come.
    pub fn clear(&mut self) {
        self.0.clear();
    }
}
