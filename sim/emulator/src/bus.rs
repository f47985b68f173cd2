//! The CAN bus in virtual time: which node sends, for how long, and what each node receives (ISO
//! 11898-1:2015).
//!
//! The model works in whole frames, not in bits. At the start of a frame it knows which nodes take
//! part, and computes from the frame's bits when and how the frame ends. The consequences:
//!
//! - Start and end of frames are exact to the bit: stuff bits, error flags, intermission, and the
//!   eight bits that an error passive transmitter leaves free. Received frames are valid one bit
//!   before the end of frame is over (10.9), transmitted ones at its end.
//! - Arbitration is among the requests pending at the start of frame. Two nodes that send the very
//!   same bits both succeed; the same identifier with other bits after it is a bit error.
//! - A node whose bit rate differs from the transmitter's by more than its bit timing tolerates
//!   ([`Line::tolerance_ppm`]) reads the frame at its own sample points, without resynchronisation. It
//!   sees a stuff error, and unless it is error passive or silent it destroys the frame for everybody.
//! - All consequences of a bad frame reach the nodes when its error delimiter is over. An error
//!   flag is superposed to 12 bits where the nodes see the error at different bits, and has 6 or 7
//!   where they see it together.
//! - A node that leaves without warning (reset, power) in the middle of its frame makes a bad frame
//!   of the same length.
//! - A controller in loop-back mode without silent mode arbitrates like any other, while the
//!   silicon would not listen. With both modes, or without a pin for TX, it plays with itself.
//! - A controller without a pin for RX sees a bit error in the first bit that it sends, and its error
//!   flag destroys the frames of the others; it starts only while the bus is idle, though it hears
//!   nothing. Without a pin for TX it sees the same, and nobody is disturbed.
//! - A line that something holds dominant ([`Bus::hold_dominant`]) breaks the frame on it, carries none, and
//!   lets the counters of the nodes on it rise (12.1.4, rules b, d and f), each at its own bit time.
//!   A frame that is broken in its arbitration field counts as a bit error, too.
//! - There are no overload frames.

pub mod confinement;
pub mod fault;
pub mod node;
pub mod port;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::fmt;

use crate::frame::{ack_delimiter, Frame, INTERMISSION_BITS};
use crate::time::{Span, Time};
use confinement::ErrorState;
use fault::{Fault, FaultAction, Faults};
use node::{BusEvent, BusNode, ErrorKind, Line, Route, Wait};

/// Bits of an error flag that all nodes send together.
const FLAG_BITS: u32 = 6;
/// Bits of an error flag whose echo follows a bit later.
const FLAG_ONE_LATE_BITS: u32 = 7;
/// Bits of an error flag that the others answer with theirs.
const FLAG_AND_ECHO_BITS: u32 = 12;
/// Recessive bits after an error flag.
const DELIMITER_BITS: u32 = 8;
/// Bits that an error passive transmitter leaves free after the intermission.
const SUSPEND_BITS: u32 = 8;
/// Recessive bits of one sequence on the way onto the bus.
const SEQUENCE_BITS: u64 = 11;
/// After so many bits, nodes that began together at different rates have noticed it.
const CLASH_BITS: u32 = 12;

/// The earliest time, in bits after the start of a frame, at which a node notices the result of the
/// frame: six bits of an error flag and eight of its delimiter. Nodes may run ahead of each other
/// by this much.
pub const SHORTEST_CONSEQUENCE_BITS: u64 = 14;

/// The result of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All nodes with the same bit rate have received it.
    Good,
    /// Acknowledged, but an injected fault kept it from the receivers (for good, or for now).
    KeptBack,
    /// Destroyed, as its transmitter sees it.
    Bad(ErrorKind),
}

/// One frame on the wire, for traces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// Start of frame.
    pub start: Time,
    /// End of the end of frame, or of the error delimiter.
    pub end: Time,
    /// What the receivers see.
    pub frame: Frame,
    /// Its transmitter's place among the nodes; `None` for a frame that an injected fault repeats
    /// or delays.
    pub from: Option<usize>,
    /// The nodes that read the frame to its end, one bit for each place. A node that starts, is
    /// bus-off or has another bit rate is not among them.
    pub readers: u64,
    /// The result.
    pub outcome: Outcome,
}

/// A node that takes part in the frame on the wire.
#[derive(Clone, Copy, Debug)]
struct Party {
    node: usize,
    epoch: u32,
    line: Line,
    /// Its bit rate is the transmitter's.
    in_tune: bool,
    /// When a receiver with another bit rate raises an error flag.
    flags_at: Option<Time>,
}

/// How the frame on the wire will end.
#[derive(Clone, Copy, Debug)]
enum Plan {
    /// Well: valid for receivers, then over.
    Good { valid: Time, end: Time },
    /// Receivers have it; the end of frame is running out.
    Delivered { end: Time },
    /// Ends with an error frame, and its delimiter ends at `end`.
    Bad { end: Time, error: Error },
}

/// The course of a bad frame.
#[derive(Clone, Copy, Debug)]
struct Error {
    /// When the error flag begins.
    at: Time,
    flag_bits: u32,
    /// What the transmitters see.
    transmit: ErrorKind,
    /// What the receivers see.
    receive: ErrorKind,
}

#[derive(Clone, Debug)]
struct Flight {
    start: Time,
    frame: Frame,
    bit: Span,
    /// The bit time of error frames: the slowest node's.
    error_bit: Span,
    /// The first of the transmitters.
    from: Option<usize>,
    transmitters: Vec<Party>,
    receivers: Vec<Party>,
    /// The frame comes from the gateway that injected faults make.
    gateway: Option<DelayedFrame>,
    fault: Option<FaultAction>,
    plan: Plan,
}

impl Flight {
    fn involves(&self, node: usize) -> bool {
        self.transmitters.iter().chain(&self.receivers).any(|party| party.node == node)
    }

    fn next(&self) -> Time {
        match self.plan {
            Plan::Good { valid, .. } => valid,
            Plan::Delivered { end } | Plan::Bad { end, .. } => end,
        }
    }
}

/// A frame that an injected fault holds back or repeats.
#[derive(Clone, Copy, Debug)]
struct DelayedFrame {
    due: Time,
    frame: Frame,
    origin: usize,
    bit: Span,
}

/// A frame that nobody sees but the controller that sends it.
#[derive(Clone, Copy, Debug)]
struct Inner {
    node: usize,
    epoch: u32,
    frame: Frame,
    /// Acknowledged by loop-back, or given up after a bit error.
    is_good: bool,
    end: Time,
    bit: Span,
}

/// A node that wants to start a frame.
#[derive(Clone, Copy, Debug)]
struct Contender {
    /// `None`: the gateway.
    party: Option<Party>,
    frame: Frame,
    bit: Span,
}

impl Contender {
    fn is_deaf(&self) -> bool {
        self.party.is_some_and(|party| party.line.is_deaf())
    }
}

/// Something holds the line dominant.
#[derive(Clone, Debug, Default)]
struct Dominant {
    /// The transmitters whose frame it has broken, as their places and epochs.
    broken: Vec<(usize, u32)>,
    /// When the counters of each node rise next.
    next: Vec<Time>,
}

type Sink = Box<dyn FnMut(&Record)>;

/// The wire and the state of its frames. The caller passes the nodes to each call, always in the
/// same order.
#[derive(Default)]
pub struct Bus {
    now: Time,
    /// The intermission is over: a frame may start.
    free_at: Time,
    /// The last dominant bit is over.
    recessive_since: Time,
    flight: Option<Flight>,
    inner: Vec<Inner>,
    /// Until when each node must not start a frame.
    suspended: Vec<Time>,
    held: VecDeque<DelayedFrame>,
    dominant: Option<Dominant>,
    faults: Faults,
    sinks: Vec<Sink>,
    frames: u64,
    errors: u64,
}

impl fmt::Debug for Bus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Bus").field("now", &self.now).field("flight", &self.flight).finish_non_exhaustive()
    }
}

fn bits(bit: Span, count: u32) -> Span {
    Span(bit.0.saturating_mul(u64::from(count)))
}

/// Whether bits of two lengths are the same to a node with this tolerance. A bit has 10^8 ps at most.
fn in_tune(a: Span, b: Span, tolerance_ppm: u32) -> bool {
    a.0.abs_diff(b.0) * 1_000_000 <= a.0.min(b.0) * u64::from(tolerance_ppm)
}

/// When a node with another bit rate notices that it does not understand the frame: at its sixth
/// equal sample in a row, or at the frame's end.
fn misread(wire: &[bool], bit: Span, line: &Line) -> Span {
    let (mut last, mut run) = (None, 0);
    let mut at = line.sample;
    loop {
        let level = match at.0.checked_div(bit.0).and_then(|n| wire.get(usize::try_from(n).ok()?)) {
            Some(level) => *level,
            None => return Span(bit.0 * wire.len() as u64),
        };
        run = if last == Some(level) { run + 1 } else { 1 };
        last = Some(level);
        if run == 6 {
            return at;
        }
        at = Span(at.0 + line.bit.0.max(1));
    }
}

impl Bus {
    /// A bus on which nothing has happened yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The time up to which everything on the bus is decided.
    #[must_use]
    pub fn now(&self) -> Time {
        self.now
    }

    /// Gives every frame, good or bad, to `sink` when it is over.
    pub fn add_sink(&mut self, sink: impl FnMut(&Record) + 'static) {
        self.sinks.push(Box::new(sink));
    }

    /// Injects a fault from now on. Returns a number for [`fault_hits`](Self::fault_hits).
    pub fn inject(&mut self, fault: Fault) -> usize {
        self.faults.add(fault)
    }

    /// How many frames the fault has hit.
    #[must_use]
    pub fn fault_hits(&self, fault: usize) -> u64 {
        self.faults.hits(fault)
    }

    /// Removes all faults. Frames that are held back are still sent.
    pub fn clear_faults(&mut self) {
        self.faults.clear();
    }

    /// From now on something holds the line dominant (a short circuit, a transceiver without its supply),
    /// or lets it go.
    pub fn hold_dominant(&mut self, is_held: bool, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        match (is_held, self.dominant.take()) {
            (true, None) => self.fall(nodes),
            (true, dominant @ Some(_)) => self.dominant = dominant,
            (false, None) => {}
            (false, Some(_)) => {
                let bit = nodes.iter().filter_map(|node| node.line()).map(|line| line.bit).max();
                self.recessive_since = now;
                self.free_at = now + bits(bit.unwrap_or_default(), DELIMITER_BITS + INTERMISSION_BITS);
                for node in nodes {
                    node.event(BusEvent::Ended, now);
                }
            }
        }
    }

    /// The line falls for a long time: the frame on it is broken, and idle nodes take the edge for the
    /// start of one.
    fn fall(&mut self, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        let mut dominant = Dominant::default();
        let is_idle = self.flight.is_none();
        if let Some(flight) = self.flight.take() {
            dominant.broken = flight.transmitters.iter().map(|party| (party.node, party.epoch)).collect();
            let [transmit, receive] = [ErrorKind::BitRecessive, ErrorKind::Stuff];
            let error = Error { at: now, flag_bits: FLAG_BITS, transmit, receive };
            self.fail(flight, now, error, nodes);
        }
        // Fourteen bits from the beginning of the flag (rule f), which follows the bit error or six equal bits.
        let until_rise = if is_idle { FLAG_BITS } else { 1 } + FLAG_BITS + DELIMITER_BITS;
        for node in nodes.iter_mut() {
            node.event(BusEvent::Started { own: false }, now);
            if is_idle && node.line().is_some_and(|line| line.hears()) {
                node.event(BusEvent::ReceiveFailed { kind: ErrorKind::Stuff, first: true }, now);
            }
            let bit = node.line().map_or(Span(0), |line| line.bit);
            dominant.next.push(now + bits(bit, until_rise));
        }
        self.dominant = Some(dominant);
    }

    /// When the counters of this node rise next because the line stays dominant. A counter that has
    /// reached its end, or a node that is off the bus, rests.
    fn next_rise(&self, n: usize, node: &dyn BusNode) -> Option<Time> {
        let dominant = self.dominant.as_ref()?;
        node.line().filter(Line::hears)?;
        let sent = dominant.broken.contains(&(n, node.epoch()));
        let rests = !sent && node.confinement().rec() == u8::MAX;
        (!rests).then(|| dominant.next.get(n).copied().unwrap_or(self.now))
    }

    /// The counters rise: by 8 for each 8 bits that the line stays dominant after an error flag.
    fn rise(&mut self, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        for (n, node) in nodes.iter_mut().enumerate() {
            if self.next_rise(n, *node).is_none_or(|at| at > now) {
                continue;
            }
            let bit = node.line().map_or(Span(0), |line| line.bit);
            let Some(dominant) = &mut self.dominant else { return };
            let own = dominant.broken.contains(&(n, node.epoch()));
            dominant.next.resize(dominant.next.len().max(n + 1), now);
            dominant.next[n] = now + bits(bit, DELIMITER_BITS);
            node.event(BusEvent::StaysDominant { own }, now);
        }
    }

    /// The number of good frames and of bad ones.
    #[must_use]
    pub fn totals(&self) -> (u64, u64) {
        (self.frames, self.errors)
    }

    /// When the next event happens if no node requests anything else.
    #[must_use]
    pub fn next_event(&self, nodes: &[&mut dyn BusNode]) -> Option<Time> {
        let flight = self.flight.as_ref().map(Flight::next);
        let inner = self.inner.iter().map(|inner| inner.end);
        let held = self.held.iter().map(|held| held.due.max(self.free_at)).filter(|_| !self.is_occupied());
        let nodes = nodes.iter().enumerate().filter_map(|(n, node)| self.next_of_node(n, *node));
        flight.into_iter().chain(inner).chain(held).chain(nodes).min().map(|at| at.max(self.now))
    }

    fn next_of_node(&self, n: usize, node: &dyn BusNode) -> Option<Time> {
        let leaves = node.leaving().filter(|_| !self.is_busy(n, node));
        let joins = self.counted_wait(node).map(|(wait, from)| {
            let sequence = wait.bit.0.saturating_mul(SEQUENCE_BITS);
            from + Span(sequence.saturating_mul(u64::from(wait.sequences)))
        });
        let starts = self.next_start(n, node);
        [leaves, joins, starts, self.next_rise(n, node)].into_iter().flatten().min()
    }

    /// Whether a frame of or for the node is under way. A line that stays dominant keeps it in an error
    /// frame.
    fn is_busy(&self, n: usize, node: &dyn BusNode) -> bool {
        self.flight.as_ref().is_some_and(|flight| flight.involves(n))
            || self.inner.iter().any(|inner| inner.node == n)
            || self.dominant.is_some() && node.line().is_some_and(|line| line.hears())
    }

    /// Whether a frame is on the line, or it stays dominant.
    fn is_occupied(&self) -> bool {
        self.flight.is_some() || self.dominant.is_some()
    }

    /// The recessive bits that the node waits for, if any pass now, and since when they have.
    fn counted_wait(&self, node: &dyn BusNode) -> Option<(Wait, Time)> {
        let wait = node.wait().filter(|wait| !self.is_occupied() || !wait.hears)?;
        let from = if wait.hears { wait.since.max(self.recessive_since) } else { wait.since };
        Some((wait, from))
    }

    /// The earliest time at which the node could start a frame.
    fn next_start(&self, n: usize, node: &dyn BusNode) -> Option<Time> {
        let line = node.line()?;
        let request = match node.request(self.now) {
            Some(_) => self.now,
            None => node.next_request(self.now)?,
        };
        let allowed = request.max(self.suspended.get(n).copied().unwrap_or_default());
        let at_rest = || (!self.is_occupied()).then_some(allowed.max(self.free_at));
        match line.route() {
            Route::Nowhere => None,
            Route::Inside if self.inner.iter().any(|inner| inner.node == n) => None,
            Route::Inside if line.hears() => at_rest(),
            Route::Inside => Some(allowed),
            Route::Bus => at_rest(),
        }
    }

    /// Processes all events up to and including `to`. Every node must have reached `to`.
    pub fn advance(&mut self, to: Time, nodes: &mut [&mut dyn BusNode]) {
        self.suspended.resize(nodes.len().max(self.suspended.len()), Time(0));
        while let Some(at) = self.next_event(nodes) {
            if at > to {
                break;
            }
            self.now = at;
            self.step(nodes);
        }
        self.now = self.now.max(to);
        for node in nodes {
            node.resolved(to);
        }
    }

    /// Processes everything that is due now, in this order: ends, leaving, joining, starts.
    fn step(&mut self, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        if self.flight.as_ref().is_some_and(|flight| flight.next() <= now) {
            if let Some(flight) = self.flight.take() {
                self.progress(flight, nodes);
            }
        }
        self.end_inner(nodes);
        for (n, node) in nodes.iter_mut().enumerate() {
            if !self.is_busy(n, *node) && node.leaving().is_some_and(|since| since <= now) {
                node.event(BusEvent::Released, now);
            }
        }
        self.rise(nodes);
        self.count_recessive(nodes);
        self.start_inner(nodes);
        if !self.is_occupied() && now >= self.free_at {
            self.start(nodes);
        }
    }

    /// Reports to the nodes that wait for recessive bits how many have passed.
    fn count_recessive(&mut self, nodes: &mut [&mut dyn BusNode]) {
        for node in nodes {
            let Some((wait, from)) = self.counted_wait(*node) else { continue };
            let heard = self.now - from;
            let sequences = heard.0.checked_div(wait.bit.0.saturating_mul(SEQUENCE_BITS)).unwrap_or(0);
            let sequences = u32::try_from(sequences).unwrap_or(u32::MAX).min(wait.sequences);
            if sequences > 0 {
                node.event(BusEvent::Recessive { sequences }, self.now);
            }
        }
    }

    // --- frames that nobody else sees
    // ------------------------------------------------------------------------------

    fn start_inner(&mut self, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        for (n, node) in nodes.iter_mut().enumerate() {
            let Some(line) = node.line().filter(|line| line.route() == Route::Inside) else { continue };
            let waits = line.hears() && (self.is_occupied() || self.free_at > now);
            let free = self.inner.iter().all(|inner| inner.node != n) && self.suspended[n] <= now && !waits;
            if let Some(frame) = node.request(now).filter(|_| free) {
                let is_good = line.loopback;
                let length = if is_good { frame.wire_len() } else { 1 + FLAG_BITS + DELIMITER_BITS };
                let (epoch, end) = (node.epoch(), now + bits(line.bit, length));
                self.inner.push(Inner { node: n, epoch, frame, is_good, end, bit: line.bit });
                node.event(BusEvent::Started { own: true }, now);
            }
        }
    }

    fn end_inner(&mut self, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        let suspended = &mut self.suspended;
        self.inner.retain(|inner| {
            if inner.end > now {
                return true;
            }
            if let Some(node) = nodes.get_mut(inner.node).filter(|node| node.epoch() == inner.epoch) {
                if inner.is_good {
                    node.event(BusEvent::Received(inner.frame), now);
                    node.event(BusEvent::Transmitted, now);
                } else {
                    let kind = ErrorKind::BitDominant;
                    node.event(BusEvent::TransmitFailed { kind, exempt: false }, now);
                }
                node.event(BusEvent::Ended, now);
            }
            suspended[inner.node] = now + bits(inner.bit, INTERMISSION_BITS);
            false
        });
    }

    // --- start of a frame
    // ------------------------------------------------------------------------------------------

    fn contenders(&self, nodes: &[&mut dyn BusNode]) -> Vec<Contender> {
        let now = self.now;
        let from_nodes = nodes.iter().enumerate().filter_map(|(n, node)| {
            let line = node.line().filter(|line| line.route() == Route::Bus)?;
            let frame = node.request(now).filter(|_| self.suspended[n] <= now)?;
            let party = Party { node: n, epoch: node.epoch(), line, in_tune: true, flags_at: None };
            Some(Contender { party: Some(party), frame, bit: line.bit })
        });
        let held = self.held.iter().find(|held| held.due <= now);
        let from_gateway = held.map(|held| Contender { party: None, frame: held.frame, bit: held.bit });
        from_nodes.chain(from_gateway).collect()
    }

    fn start(&mut self, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        let contenders = self.contenders(nodes);
        let Some(strongest) = contenders.iter().min_by_key(|contender| contender.frame.arbitration_key())
        else {
            return;
        };
        let (frame, bit) = (strongest.frame, strongest.bit);
        let key = frame.arbitration_key();
        let clash = contenders.iter().any(|other| {
            let tolerance = other.party.map_or(port::TOLERANCE_PPM, |party| party.line.tolerance_ppm);
            other.is_deaf() || !in_tune(other.bit, bit, tolerance)
        });
        // A node that does not read the others' bits as bits does not lose the arbitration against
        // them.
        let (winners, losers): (Vec<&Contender>, Vec<&Contender>) =
            contenders.iter().partition(|contender| clash || contender.frame.arbitration_key() == key);
        let transmitters: Vec<Party> = winners.iter().filter_map(|winner| winner.party).collect();
        let gateway = match winners.iter().find(|winner| winner.party.is_none()) {
            Some(_) => self.take_held(),
            None => None,
        };

        for loser in losers.iter().filter_map(|loser| loser.party) {
            nodes[loser.node].event(BusEvent::Started { own: true }, now);
            nodes[loser.node].event(BusEvent::ArbitrationLost, now);
        }
        let wire = frame.wire_bits();
        let mut receivers = Vec::new();
        for (n, node) in nodes.iter_mut().enumerate() {
            let sends = transmitters.iter().any(|party| party.node == n);
            let lost = losers.iter().any(|loser| loser.party.is_some_and(|party| party.node == n));
            if !lost {
                node.event(BusEvent::Started { own: sends }, now);
            }
            if let Some(line) = node.line().filter(|line| !sends && line.hears()) {
                let in_tune = !clash && in_tune(line.bit, bit, line.tolerance_ppm);
                let active = line.drives() && node.confinement().state() == ErrorState::Active;
                let flags_at = (!in_tune && !clash && active).then(|| now + misread(&wire, bit, &line));
                receivers.push(Party { node: n, epoch: node.epoch(), line, in_tune, flags_at });
            }
        }
        let fault = match (&transmitters[..], gateway) {
            ([sender, ..], None) => self.faults.decide(&frame, sender.node),
            _ => None,
        };
        let error_bit =
            transmitters.iter().chain(&receivers).map(|party| party.line.bit).max().unwrap_or(bit);
        let error = self.foresee(&winners, &receivers, &wire, clash, fault);
        let wire_len = u32::try_from(wire.len()).unwrap_or(u32::MAX);
        let plan = match error {
            Some(error) => {
                Plan::Bad { end: error.at + bits(error_bit, error.flag_bits + DELIMITER_BITS), error }
            }
            None => Plan::Good { valid: now + bits(bit, wire_len - 1), end: now + bits(bit, wire_len) },
        };
        let from = transmitters.first().map(|party| party.node);
        self.flight = Some(Flight {
            start: now,
            from,
            frame,
            bit,
            error_bit,
            transmitters,
            receivers,
            gateway,
            fault,
            plan,
        });
    }

    /// Takes the frame that the gateway is sending; it comes back if that fails.
    fn take_held(&mut self) -> Option<DelayedFrame> {
        let n = self.held.iter().position(|held| held.due <= self.now)?;
        self.held.remove(n)
    }

    /// The first error of the frame that starts now, if there is one.
    fn foresee(
        &self,
        winners: &[&Contender],
        receivers: &[Party],
        wire: &[bool],
        clash: bool,
        fault: Option<FaultAction>,
    ) -> Option<Error> {
        let now = self.now;
        let (frame, bit) = (winners.first()?.frame, winners.first()?.bit);
        if winners.iter().any(|winner| winner.is_deaf()) {
            return Some(Error {
                at: now + bits(bit, 1),
                flag_bits: FLAG_AND_ECHO_BITS,
                transmit: ErrorKind::BitDominant,
                receive: ErrorKind::Stuff,
            });
        }
        if clash {
            let slowest = winners.iter().map(|winner| winner.bit).max()?;
            return Some(Error {
                at: now + bits(slowest, CLASH_BITS),
                flag_bits: FLAG_AND_ECHO_BITS,
                transmit: ErrorKind::BitRecessive,
                receive: ErrorKind::Stuff,
            });
        }
        let mut errors = Vec::new();
        for other in winners.iter().filter(|other| other.frame != frame) {
            let differs = other.frame.wire_bits().iter().zip(wire).position(|(a, b)| a != b);
            errors.push(Error {
                at: now + Span(bit.0 * (differs.unwrap_or(wire.len()) as u64 + 1)),
                flag_bits: FLAG_AND_ECHO_BITS,
                transmit: ErrorKind::BitRecessive,
                receive: ErrorKind::Stuff,
            });
        }
        errors.extend(receivers.iter().filter_map(|party| party.flags_at).map(|at| Error {
            at,
            flag_bits: FLAG_AND_ECHO_BITS,
            transmit: ErrorKind::BitRecessive,
            receive: ErrorKind::Stuff,
        }));
        let wire_len = u32::try_from(wire.len()).unwrap_or(u32::MAX);
        if fault == Some(FaultAction::Disturb) {
            // A CRC error shows after the ACK delimiter (10.11).
            errors.push(Error {
                at: now + bits(bit, ack_delimiter(wire_len) + 1),
                flag_bits: FLAG_ONE_LATE_BITS,
                transmit: ErrorKind::BitRecessive,
                receive: ErrorKind::Crc,
            });
        }
        let needs_acknowledge =
            winners.iter().any(|winner| winner.party.is_none_or(|party| !party.line.loopback));
        if needs_acknowledge && !receivers.iter().any(|party| party.in_tune && party.line.drives()) {
            errors.push(self.no_acknowledge(now + bits(bit, ack_delimiter(wire_len))));
        }
        errors.into_iter().min_by_key(|error| error.at)
    }

    fn no_acknowledge(&self, at: Time) -> Error {
        Error { at, flag_bits: FLAG_BITS, transmit: ErrorKind::Acknowledge, receive: ErrorKind::Form }
    }

    // --- end of a frame
    // --------------------------------------------------------------------------------------------

    fn progress(&mut self, flight: Flight, nodes: &mut [&mut dyn BusNode]) {
        match flight.plan {
            Plan::Good { end, .. } => self.deliver(flight, end, nodes),
            Plan::Delivered { end } => self.succeed(flight, end, nodes),
            Plan::Bad { end, error } => self.fail(flight, end, error, nodes),
        }
    }

    fn deliver(&mut self, mut flight: Flight, end: Time, nodes: &mut [&mut dyn BusNode]) {
        let now = self.now;
        // A node that has left in the meantime neither sends nor acknowledges.
        let there = |party: &Party| {
            nodes.get(party.node).is_some_and(|node| node.epoch() == party.epoch && node.line().is_some())
        };
        flight.transmitters.retain(there);
        flight.receivers.retain(there);
        let sent = flight.gateway.is_some() || !flight.transmitters.is_empty();
        let acknowledged = flight.transmitters.iter().any(|party| party.line.loopback)
            || flight.receivers.iter().any(|party| party.in_tune && party.line.drives());
        if !sent || !acknowledged {
            let mut error = self.no_acknowledge(now);
            if !sent {
                error.receive = ErrorKind::Stuff;
            }
            let end = now + bits(flight.error_bit, error.flag_bits + DELIMITER_BITS);
            flight.plan = Plan::Bad { end, error };
            self.flight = Some(flight);
            return;
        }
        if let Some(FaultAction::Alter { byte, mask }) = flight.fault {
            flight.frame = flight.frame.with_flipped_bits(byte, mask);
        }
        let kept_back = matches!(flight.fault, Some(FaultAction::Drop | FaultAction::Delay(_)));
        for party in flight.receivers.iter().filter(|party| party.in_tune) {
            let event = if kept_back || flight.gateway.is_some_and(|held| held.origin == party.node) {
                BusEvent::Missed
            } else {
                BusEvent::Received(flight.frame)
            };
            nodes[party.node].event(event, now);
        }
        for party in flight.transmitters.iter().filter(|party| party.line.loopback) {
            nodes[party.node].event(BusEvent::Received(flight.frame), now);
        }
        flight.plan = Plan::Delivered { end };
        self.flight = Some(flight);
    }

    fn succeed(&mut self, flight: Flight, end: Time, nodes: &mut [&mut dyn BusNode]) {
        self.frames += 1;
        for party in &flight.transmitters {
            self.notify(party, BusEvent::Transmitted, nodes);
        }
        for party in flight.receivers.iter().filter(|party| !party.in_tune) {
            self.notify(party, BusEvent::ReceiveFailed { kind: ErrorKind::Stuff, first: false }, nodes);
        }
        if let Some(origin) = flight.from {
            let (frame, bit) = (flight.frame, flight.bit);
            match flight.fault {
                Some(FaultAction::Delay(span)) => {
                    self.held.push_back(DelayedFrame { due: end + span, frame, origin, bit });
                }
                Some(FaultAction::Duplicate) => {
                    self.held.push_back(DelayedFrame { due: end, frame, origin, bit });
                }
                _ => {}
            }
        }
        let outcome = match flight.fault {
            Some(FaultAction::Drop | FaultAction::Delay(_)) => Outcome::KeptBack,
            _ => Outcome::Good,
        };
        // ACK delimiter and end of frame are recessive.
        let recessive = bits(flight.bit, 1 + crate::frame::END_OF_FRAME_BITS);
        self.recessive_since = Time(end.0.saturating_sub(recessive.0));
        self.finish(&flight, flight.bit, end, outcome, nodes);
    }

    fn fail(&mut self, flight: Flight, end: Time, error: Error, nodes: &mut [&mut dyn BusNode]) {
        self.errors += 1;
        let passive = |party: &Party| {
            nodes.get(party.node).is_some_and(|node| node.confinement().state() == ErrorState::Passive)
        };
        // An error passive transmitter's flag is recessive: a node that only listens takes the
        // frame for a good one.
        let unheard = error.transmit == ErrorKind::Acknowledge
            && error.receive == ErrorKind::Form
            && flight.transmitters.iter().all(passive);
        for party in &flight.transmitters {
            let exempt = error.transmit == ErrorKind::Acknowledge
                && nodes
                    .get(party.node)
                    .is_some_and(|node| node.confinement().state() == ErrorState::Passive);
            self.notify(party, BusEvent::TransmitFailed { kind: error.transmit, exempt }, nodes);
        }
        for party in &flight.receivers {
            let event = match party.in_tune {
                true if unheard => BusEvent::Received(flight.frame),
                true => BusEvent::ReceiveFailed { kind: error.receive, first: false },
                false => BusEvent::ReceiveFailed {
                    kind: ErrorKind::Stuff,
                    first: party.flags_at == Some(error.at),
                },
            };
            self.notify(party, event, nodes);
        }
        if let Some(held) = flight.gateway {
            // The gateway repeats it.
            self.held.push_front(DelayedFrame { due: end, ..held });
        }
        self.recessive_since = error.at + bits(flight.error_bit, error.flag_bits);
        self.finish(&flight, flight.error_bit, end, Outcome::Bad(error.transmit), nodes);
    }

    fn finish(
        &mut self,
        flight: &Flight,
        bit: Span,
        end: Time,
        outcome: Outcome,
        nodes: &mut [&mut dyn BusNode],
    ) {
        self.free_at = end + bits(bit, INTERMISSION_BITS);
        for party in &flight.transmitters {
            if let Some(node) = nodes.get(party.node) {
                if node.confinement().state() == ErrorState::Passive {
                    self.suspended[party.node] = self.free_at + bits(party.line.bit, SUSPEND_BITS);
                }
            }
        }
        for node in nodes {
            node.event(BusEvent::Ended, self.now);
        }
        let readers = flight.receivers.iter().filter(|party| party.in_tune);
        let readers =
            readers.fold(0, |readers, party| readers | 1u64.checked_shl(party.node as u32).unwrap_or(0));
        let Flight { start, frame, from, .. } = *flight;
        let record = Record { start, end, frame, from, readers, outcome };
        for sink in &mut self.sinks {
            sink(&record);
        }
    }

    /// Sends the event to the party, if the node has not been reset since the frame began.
    fn notify(&self, party: &Party, event: BusEvent, nodes: &mut [&mut dyn BusNode]) {
        if let Some(node) = nodes.get_mut(party.node).filter(|node| node.epoch() == party.epoch) {
            node.event(event, self.now);
        }
    }
}
