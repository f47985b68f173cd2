//! A slave: NMT, boot-up, heartbeat and SDO server of one node-ID.
//!
//! The owner passes every received frame to [`Node::handle`], then fetches frames with
//! [`Node::poll`] until there are none. It calls `poll` again at least every few milliseconds.

use crate::bit_rate::BitRate;
use crate::frame::{CobId, Frame, NodeId};
use crate::heartbeat::Heartbeat;
use crate::nmt::{self, NmtCommand, NmtState};
use crate::od::Objects;
use crate::sdo::server::{Config as SdoConfig, SdoServer};
use crate::time::Instant;

/// The effect of the NMT master's Start, Stop and EnterPreOperational on the node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum NmtPolicy {
    /// The node stays PRE-OPERATIONAL, like a bootloader: SDO must always work.
    #[default]
    StayPreOperational,
    /// The node follows the master.
    Follow,
}

/// The configuration of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// Whether it sends a boot-up message (CiA 301 clause 7.3.2.2.3).
    pub boot_up: bool,
    /// Period of the heartbeat in milliseconds, 0 for none.
    pub heartbeat_ms: u16,
    /// Whether it follows the NMT commands that change its state.
    pub nmt: NmtPolicy,
    /// The configuration of the SDO server.
    pub sdo: SdoConfig,
}

impl Default for Config {
    /// With a boot-up message, without heartbeat; it stays PRE-OPERATIONAL.
    fn default() -> Self {
        Self { boot_up: true, heartbeat_ms: 0, nmt: NmtPolicy::default(), sdo: SdoConfig::DEFAULT }
    }
}

/// A slave on the bus.
#[derive(Debug)]
pub struct Node {
    id: NodeId,
    boot_up: bool,
    nmt: NmtPolicy,
    state: NmtState,
    heartbeat: Heartbeat,
    sdo: SdoServer,
}

impl Node {
    /// A node that has not sent its boot-up message yet.
    #[must_use]
    pub const fn new(id: NodeId, config: Config) -> Self {
        Self {
            id,
            boot_up: config.boot_up,
            nmt: config.nmt,
            state: NmtState::Initialisation,
            heartbeat: Heartbeat::new(config.heartbeat_ms, Instant::from_millis(0)),
            sdo: SdoServer::new(id, config.sdo),
        }
    }

    /// Its node-ID.
    #[must_use]
    pub const fn id(&self) -> NodeId {
        self.id
    }

    /// Its NMT state; [`NmtState::Initialisation`] until the boot-up message is fetched.
    #[must_use]
    pub const fn state(&self) -> NmtState {
        self.state
    }

    /// Whether no SDO transfer runs and no SDO answer waits to be fetched.
    #[must_use]
    pub const fn is_sdo_idle(&self) -> bool {
        self.sdo.is_idle()
    }

    /// Whether an SDO answer waits to be fetched.
    #[must_use]
    pub const fn has_sdo_answer(&self) -> bool {
        self.sdo.has_answer()
    }

    /// The bit rate of the bus, see [`bit_rate`](crate::sdo::server::Config::bit_rate).
    pub fn set_bit_rate(&mut self, bit_rate: BitRate) {
        self.sdo.set_bit_rate(bit_rate);
    }

    /// Ends a running SDO transfer without a message to the client.
    pub fn end_transfer(&mut self, objects: &mut impl Objects) {
        self.sdo.reset(objects);
    }

    /// Sets the value of 1017h: the heartbeat's period in milliseconds, 0 for none. The same value
    /// again changes nothing, so the owner may call this after every frame.
    pub fn set_heartbeat_ms(&mut self, period_ms: u16, now: Instant) {
        self.heartbeat.set_period(period_ms, now);
    }

    /// Processes any received frame; returns the NMT command if the frame is one for this node. The
    /// node itself has carried out Start, Stop and `EnterPreOperational`; the owner carries out the
    /// two resets: it restarts the device, or makes a node with the node-ID that is active now.
    pub fn handle(&mut self, frame: &Frame, now: Instant, objects: &mut impl Objects) -> Option<NmtCommand> {
        // A node accepts nothing before its boot-up message.
        if self.state == NmtState::Initialisation {
            return None;
        }
        if let Some(command) = NmtCommand::parse(frame, self.id) {
            self.command(command, objects);
            return Some(command);
        }
        if self.state != NmtState::Stopped {
            self.sdo.handle(frame, now, objects);
        }
        if let Some(exchange) = objects.exchange() {
            exchange.handle(frame);
        }
        None
    }

    /// The next frame to send; `None` if there is none.
    pub fn poll(&mut self, now: Instant, objects: &mut impl Objects) -> Option<Frame> {
        if self.state == NmtState::Initialisation {
            self.state = NmtState::PreOperational;
            self.heartbeat = Heartbeat::new(self.heartbeat.period_ms(), now);
            if self.boot_up {
                return Some(nmt::boot_up(self.id));
            }
        }
        if let Some(answer) = self.sdo.poll(now, objects) {
            return Some(answer);
        }
        if self.state != NmtState::Stopped {
            if let Some(emergency) = objects.next_emergency() {
                return Some(Frame::full(CobId::emcy(self.id), emergency));
            }
        }
        // A device that has a PDO to send at any time is alive all the same.
        if self.heartbeat.take_due(now) {
            return Some(nmt::state_message(self.id, self.state));
        }
        // Without one, nothing is left of this in the program.
        objects.exchange().filter(|_| self.state == NmtState::Operational)?.poll(now)
    }

    fn command(&mut self, command: NmtCommand, objects: &mut impl Objects) {
        let state = match (command, self.nmt) {
            (NmtCommand::Start, NmtPolicy::Follow) => NmtState::Operational,
            (NmtCommand::Stop, NmtPolicy::Follow) => {
                // SDO does not work in state stopped, so no request could end the transfer.
                self.sdo.reset(objects);
                NmtState::Stopped
            }
            (NmtCommand::EnterPreOperational, NmtPolicy::Follow) => NmtState::PreOperational,
            _ => return,
        };
        self.state = state;
        if let Some(exchange) = objects.exchange() {
            exchange.state_changed(state);
        }
    }
}
