//! A port for the host: a controller with queues instead of mailboxes, for tests, clients and
//! traces.

use std::collections::VecDeque;

use crate::bus::confinement::{Confinement, ErrorState};
use crate::bus::node::{BusEvent, BusNode, Line, Pins, Wait};
use crate::frame::Frame;
use crate::time::{Span, Time};

/// Frames that a queue of a port holds before it drops the oldest.
pub const QUEUE: usize = 1 << 16;
const RECOVERY_SEQUENCES: u32 = 128;
const PICOS: u64 = 1_000_000_000_000;

/// A frame to be sent, and the ticket that identifies it for its sender.
#[derive(Clone, Copy, Debug)]
struct Outgoing {
    at: Time,
    frame: Frame,
    ticket: u64,
}

/// A controller that takes every frame, sends its own in the order in which it got them, and comes
/// back from bus-off by itself.
#[derive(Clone, Debug)]
pub struct HostPort {
    bit: Span,
    silent: bool,
    confinement: Confinement,
    /// Bus-off: since when recessive bits count, and sequences left.
    recovery: Option<(Time, u32)>,
    sending: bool,
    outgoing: VecDeque<Outgoing>,
    received: VecDeque<(Time, Frame)>,
    sent: VecDeque<(Time, u64, Frame)>,
    lost: u64,
    tickets: u64,
}

impl HostPort {
    /// A port at this bit rate (in bit/s, 1 at least), sampling at 87.5 %.
    #[must_use]
    pub fn new(bit_rate: u32) -> Self {
        Self {
            bit: Span(PICOS / u64::from(bit_rate.max(1))),
            silent: false,
            confinement: Confinement::default(),
            recovery: None,
            sending: false,
            outgoing: VecDeque::new(),
            received: VecDeque::new(),
            sent: VecDeque::new(),
            lost: 0,
            tickets: 0,
        }
    }

    /// Sets whether the port only listens, without acknowledging.
    pub fn set_silent(&mut self, silent: bool) {
        self.silent = silent;
    }

    /// Changes over to another bit rate (in bit/s, 1 at least), between two frames.
    pub fn set_bit_rate(&mut self, bit_rate: u32) {
        self.bit = Span(PICOS / u64::from(bit_rate.max(1)));
    }

    /// Puts a frame into the queue; it may go out from `at` on. Gives the ticket under which
    /// [`sent`](Self::sent) reports it.
    pub fn send(&mut self, frame: Frame, at: Time) -> u64 {
        self.tickets += 1;
        self.outgoing.push_back(Outgoing { at, frame, ticket: self.tickets });
        self.tickets
    }

    /// Frames that have not gone out yet.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.outgoing.len()
    }

    /// Withdraws all frames that have not gone out, except a frame on the wire.
    pub fn cancel(&mut self) {
        self.outgoing.truncate(usize::from(self.sending));
    }

    /// The oldest frame received and when its reception was complete.
    pub fn receive(&mut self) -> Option<(Time, Frame)> {
        self.received.pop_front()
    }

    /// The oldest frame sent that has not been asked for: when it had gone out, its ticket, and
    /// itself.
    pub fn sent(&mut self) -> Option<(Time, u64, Frame)> {
        self.sent.pop_front()
    }

    /// The number of received frames that were dropped because they were not fetched in time.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Error counters.
    #[must_use]
    pub fn error_counters(&self) -> Confinement {
        self.confinement
    }

    fn check_bus_off(&mut self, now: Time) {
        if self.confinement.state() == ErrorState::BusOff && self.recovery.is_none() {
            self.recovery = Some((now, RECOVERY_SEQUENCES));
        }
    }
}

/// The tolerance of a host's adapter, and of a gateway's: 2/(13 × 16 - 2), that of 16 quanta with a jump
/// width and a segment 2 of two, rounded.
pub(super) const TOLERANCE_PPM: u32 = 10_000;

impl BusNode for HostPort {
    fn line(&self) -> Option<Line> {
        let sample = Span(self.bit.0 / 8 * 7);
        self.recovery.is_none().then_some(Line {
            bit: self.bit,
            sample,
            tolerance_ppm: TOLERANCE_PPM,
            silent: self.silent,
            loopback: false,
            pins: Pins::BOTH,
        })
    }

    fn epoch(&self) -> u32 {
        0
    }

    fn confinement(&self) -> Confinement {
        self.confinement
    }

    fn request(&self, now: Time) -> Option<Frame> {
        self.outgoing.front().filter(|out| out.at <= now && !self.sending).map(|out| out.frame)
    }

    fn next_request(&self, now: Time) -> Option<Time> {
        self.outgoing.front().filter(|out| out.at > now).map(|out| out.at)
    }

    fn wait(&self) -> Option<Wait> {
        self.recovery.map(|(since, sequences)| Wait { since, sequences, bit: self.bit, hears: true })
    }

    fn leaving(&self) -> Option<Time> {
        None
    }

    fn event(&mut self, event: BusEvent, now: Time) {
        match event {
            BusEvent::Started { own } => self.sending = own,
            BusEvent::ArbitrationLost => self.sending = false,
            BusEvent::Transmitted => {
                self.sending = false;
                self.confinement.transmitted();
                if let Some(out) = self.outgoing.pop_front() {
                    if self.sent.len() == QUEUE {
                        self.sent.pop_front();
                    }
                    self.sent.push_back((now, out.ticket, out.frame));
                }
            }
            BusEvent::TransmitFailed { exempt, .. } => {
                self.sending = false;
                self.confinement.transmit_failed(exempt);
                self.check_bus_off(now);
            }
            BusEvent::Received(frame) => {
                self.confinement.received();
                if self.received.len() == QUEUE {
                    self.received.pop_front();
                    self.lost += 1;
                }
                self.received.push_back((now, frame));
            }
            BusEvent::Missed => self.confinement.received(),
            BusEvent::ReceiveFailed { first, .. } => self.confinement.receive_failed(first),
            BusEvent::StaysDominant { own } => {
                self.confinement.stays_dominant(own);
                self.check_bus_off(now);
            }
            BusEvent::Recessive { sequences } => {
                if let Some((_, left)) = self.recovery {
                    let left = left.saturating_sub(sequences);
                    self.recovery = (left > 0).then_some((now, left));
                    if left == 0 {
                        self.confinement.recovered();
                    }
                }
            }
            BusEvent::Released | BusEvent::Ended => {}
        }
    }

    fn resolved(&mut self, _now: Time) {}
}

/// A place on the bus without a node.
#[derive(Clone, Copy, Debug, Default)]
pub struct Unplugged;

impl BusNode for Unplugged {
    fn line(&self) -> Option<Line> {
        None
    }
    fn epoch(&self) -> u32 {
        0
    }
    fn confinement(&self) -> Confinement {
        Confinement::default()
    }
    fn request(&self, _now: Time) -> Option<Frame> {
        None
    }
    fn next_request(&self, _now: Time) -> Option<Time> {
        None
    }
    fn wait(&self) -> Option<Wait> {
        None
    }
    fn leaving(&self) -> Option<Time> {
        None
    }
    fn event(&mut self, _event: BusEvent, _now: Time) {}
    fn resolved(&mut self, _now: Time) {}
}
