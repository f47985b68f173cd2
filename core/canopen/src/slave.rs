//! A device on the bus: its [`Node`], layer setting services, bit rate detection and the state of
//! its line in one state machine.
//!
//! The owner of the CAN controller
//!
//! 1. passes every frame received to [`Slave::handle`],
//! 2. passes the controller's state to [`Slave::observe`], every few milliseconds,
//! 3. then carries out each action that [`Slave::poll`] returns, until it returns none.
//!
//! The first actions of a new slave set filters and bit rate, so the owner has a single place for
//! them.

use crate::bit_rate::{BitRate, Detector};
use crate::frame::{CobId, Frame, NodeId};
use crate::line::{Consequence, LineEvent, Losses, Monitor, Status};
use crate::lss::{self, Lss, LssAddress, LssDevice};
use crate::nmt::NmtCommand;
use crate::node::{self, Node};
use crate::od::Objects;
use crate::time::Instant;

/// The interface between a slave and its device.
pub trait SlaveDevice: Objects + LssDevice {
    /// Reports an event of the line; the device may send an emergency for it.
    fn line_event(&mut self, event: LineEvent) {
        let _ = event;
    }

    /// Reports the device's new node-ID, or none; its node starts (again). The slave also calls
    /// this before its first action.
    fn node_id_changed(&mut self, id: Option<NodeId>) {
        let _ = id;
    }
}

/// The configuration of a slave. [`LssDevice::supports`] for [`BitRate::Auto`] decides whether the
/// slave may detect the bit rate by listening.
#[derive(Clone, Copy, Debug, Default)]
pub struct Config {
    /// The configuration of the node.
    pub node: node::Config,
    /// The configuration of the layer setting services, for a device that [has](LssDevice::has_lss) them.
    pub lss: lss::Config,
    /// Whether the slave only listens until a request of the layer setting services arrives: its clock may
    /// be wrong, and a frame without an error shows that it is good enough. It has no effect on a slave
    /// without these services.
    pub is_silent: bool,
}

/// What the owner must do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// Send this frame.
    Send(Frame),
    /// Set the controller to this bit rate, never [`BitRate::Auto`], and take part in the bus.
    /// Frames that wait in the mailboxes are dropped.
    Join(BitRate),
    /// Set the controller to this bit rate and listen only.
    Listen(BitRate),
    /// Start the controller's recovery from bus-off.
    RecoverFromBusOff,
    /// Accept exactly the frames with these identifiers, and with those of the device's
    /// [`Exchange`](crate::od::Exchange); the list may contain one twice.
    Accept([CobId; 4]),
}

/// A device on the bus.
#[derive(Debug)]
pub struct Slave {
    config: Config,
    /// `None` while the device has no node-ID, and until its first node was started.
    node: Option<Node>,
    started: bool,
    lss: Lss,
    line: Line,
    losses: Losses,
    /// The COB-ID of requests to the second SDO server.
    second: CobId,
    /// The node-ID or `second` has changed, and the owner must still set the filters for it.
    accept: bool,
}

/// The time from a request of the layer setting services until a silent slave joins, in milliseconds. A
/// controller that changes its mode hears nothing, and the next request may follow at once: it takes 14 ms
/// at 10 kbit/s. The rest of a longer sequence is lost at the lowest bit rates, and the master repeats it.
const JOIN_MS: u32 = 20;

#[derive(Debug)]
enum Line {
    /// The controller must be set to this rate.
    Down(BitRate),
    /// The slave detects the bit rate; the controller is set to `set`.
    Listening { detector: Detector, set: Option<BitRate> },
    /// The controller listens at this rate, until a request of the layer setting services arrives; then
    /// it joins at this time.
    Silent { rate: BitRate, join_at: Option<Instant> },
    /// The controller takes part in the bus.
    Up { monitor: Monitor, recover_from_bus_off: bool },
}

impl Slave {
    /// A device with this node-ID, or without one, on a bus with this bit rate. A device without a
    /// node-ID only sends answers of layer setting services.
    #[must_use]
    pub fn new(address: LssAddress, id: Option<NodeId>, rate: BitRate, config: Config) -> Self {
        Self {
            config,
            node: None,
            started: false,
            lss: Lss::new(address, id, config.lss),
            line: Line::Down(rate),
            losses: Losses::default(),
            second: CobId::NONE,
            accept: false,
        }
    }

    /// Its node, after the first action, unless it has no node-ID.
    #[must_use]
    pub const fn node(&self) -> Option<&Node> {
        self.node.as_ref()
    }

    /// Sets the value of 1017h: the heartbeat's period in milliseconds, 0 for none.
    pub fn set_heartbeat_ms(&mut self, period_ms: u16, now: Instant) {
        self.config.node.heartbeat_ms = period_ms;
        if let Some(node) = &mut self.node {
            node.set_heartbeat_ms(period_ms, now);
        }
    }

    /// Whether no SDO answer waits to be sent: a device must have sent all its answers before a
    /// restart. It does not wait for the end of a transfer, because only the client decides when
    /// that comes.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.node.as_ref().is_none_or(|node| !node.has_sdo_answer())
    }

    /// Whether this frame has no effect, because the slave is [silent](Config::is_silent).
    #[must_use]
    pub fn ignores(&self, frame: &Frame) -> bool {
        matches!(self.line, Line::Silent { .. }) && !frame.has_cob_id(CobId::LSS_REQUEST)
    }

    /// Processes any received frame; returns whether the NMT master requested a restart of the
    /// device. In this case a running transfer has ended, and a waiting answer was dropped.
    pub fn handle<D: SlaveDevice>(&mut self, frame: &Frame, now: Instant, device: &mut D) -> bool {
        if self.ignores(frame) {
            return false;
        }
        match self.line {
            Line::Up { .. } => {}
            Line::Silent { rate, join_at } => {
                // A frame that nobody acknowledges comes again and again.
                let join_at = join_at.unwrap_or(now + JOIN_MS);
                self.line = Line::Silent { rate, join_at: Some(join_at) };
                if D::has_lss() {
                    self.lss.handle(frame, now, device);
                }
                return false;
            }
            // A controller that only listens cannot send answers.
            _ => return false,
        }
        if D::has_lss() {
            self.lss.handle(frame, now, device);
        }
        let Some(node) = &mut self.node else { return false };
        match node.handle(frame, now, device) {
            Some(NmtCommand::ResetNode) => {
                node.end_transfer(device);
                return true;
            }
            Some(NmtCommand::ResetCommunication) => {
                let id = self.lss.reset_communication();
                self.restart(id, device);
            }
            _ => {}
        }
        if D::has_second_server() {
            let second = device.second_server().request;
            self.accept |= core::mem::replace(&mut self.second, second) != second;
        }
        if let Some(exchange) = device.exchange() {
            self.accept |= exchange.identifiers_changed();
        }
        false
    }

    /// Processes the state of the controller.
    pub fn observe<D: SlaveDevice>(&mut self, status: Status, now: Instant, device: &mut D) {
        if let Some(lost) = self.losses.observe(status.lost, now) {
            device.line_event(LineEvent::Lost(lost));
        }
        match &mut self.line {
            Line::Down(_) | Line::Silent { .. } => {}
            Line::Listening { detector, .. } => {
                if device.supports(BitRate::Auto)
                    && detector.heard(status.heard, now, |rate| device.supports(rate))
                {
                    self.line = Line::Down(detector.rate());
                }
            }
            Line::Up { monitor, recover_from_bus_off } => match monitor.observe(status.confinement, now) {
                Some(Consequence::Tell(event)) => device.line_event(event),
                Some(Consequence::RecoverFromBusOff) => *recover_from_bus_off = true,
                None => {}
            },
        }
    }

    /// Returns the owner's next action; `None` if there is none. Frames are returned only while
    /// there is `room` for one in the mailboxes.
    pub fn poll<D: SlaveDevice>(&mut self, now: Instant, room: bool, device: &mut D) -> Option<Output> {
        if !core::mem::replace(&mut self.started, true) {
            self.restart(self.lss.node_id(), device);
        }
        loop {
            if core::mem::take(&mut self.accept) {
                return Some(Output::Accept(self.identifiers::<D>()));
            }
            match &mut self.line {
                Line::Down(BitRate::Auto) if device.supports(BitRate::Auto) => {
                    let detector = Detector::new(BitRate::K125, now, |rate| device.supports(rate));
                    self.line = Line::Listening { detector, set: None };
                    continue;
                }
                &mut Line::Down(rate) if D::has_lss() && self.config.is_silent => {
                    self.line = Line::Silent { rate, join_at: None };
                    return Some(Output::Listen(rate));
                }
                &mut Line::Silent { rate, join_at } => {
                    if !join_at.is_some_and(|at| now.has_reached(at)) {
                        return None;
                    }
                    self.config.is_silent = false;
                    self.line = Line::Down(rate);
                    continue;
                }
                &mut Line::Down(rate) => {
                    self.config.node.sdo.bit_rate = rate;
                    if let Some(node) = &mut self.node {
                        node.set_bit_rate(rate);
                    }
                    self.line = Line::Up { monitor: Monitor::new(now), recover_from_bus_off: false };
                    return Some(Output::Join(rate));
                }
                Line::Listening { detector, set } => {
                    let rate = detector.rate();
                    let is_new = set.replace(rate) != Some(rate);
                    return is_new.then_some(Output::Listen(rate));
                }
                Line::Up { recover_from_bus_off, .. } => {
                    if core::mem::take(recover_from_bus_off) {
                        return Some(Output::RecoverFromBusOff);
                    }
                }
            }
            if D::has_lss() {
                self.lss.follow_store(device);
            }
            if !room {
                return None;
            }
            match D::has_lss().then(|| self.lss.poll(now)).flatten() {
                Some(lss::Output::Send(frame)) => return Some(Output::Send(frame)),
                Some(lss::Output::BitRate(rate)) => self.line = Line::Down(rate),
                Some(lss::Output::NodeId(id)) => self.restart(Some(id), device),
                None if D::has_lss() && self.lss.is_silent(now) => return None,
                None => return self.node.as_mut()?.poll(now, device).map(Output::Send),
            }
        }
    }

    /// The identifiers of the frames that it accepts.
    fn identifiers<D: LssDevice>(&self) -> [CobId; 4] {
        let lss = if D::has_lss() { CobId::LSS_REQUEST } else { CobId::NMT };
        let [nmt, request] = match &self.node {
            Some(node) => [CobId::NMT, self.config.node.sdo.request(node.id())],
            None => [lss; 2],
        };
        // Not 7FFh, which an identifier above 11 bits would be in a filter.
        let second = if self.second == CobId::NONE { nmt } else { self.second };
        [nmt, lss, request, second]
    }

    /// Starts the node (again) with this node-ID: a transfer ends, and the boot-up message is sent
    /// (again).
    fn restart(&mut self, id: Option<NodeId>, device: &mut impl SlaveDevice) {
        if let Some(node) = &mut self.node {
            node.end_transfer(device);
        }
        self.node = id.map(|id| Node::new(id, self.config.node));
        self.accept = true;
        device.node_id_changed(id);
    }
}
