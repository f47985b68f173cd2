//! Explains why a device may not answer, from the traffic on the bus.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use canopen::nmt::{parse_state_message, NmtState};
use canopen::NodeId;

use super::error::Error;
use super::session::Session;
use coboot_can::decode::state_words;
use coboot_can::health::Trouble;
use coboot_can::Health;

/// How long to listen: in most networks, heartbeats come once a second.
pub const LISTEN: Duration = Duration::from_millis(1200);

/// The traffic on the bus while a device is silent. `Display` gives the conclusion and the advice.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnosis {
    /// The silent device.
    pub node: NodeId,
    /// Frames heard, of any kind.
    pub frames: usize,
    /// The nodes that were heard, with their last reported states.
    pub heard: BTreeMap<NodeId, Option<NmtState>>,
    /// The adapter's knowledge of its bus, if it reports any.
    pub health: Option<Health>,
}

/// Listens to the bus for [`LISTEN`].
///
/// # Errors
/// [`Error::Adapter`] or [`Error::Cancelled`].
pub fn diagnose(session: &mut Session<'_>) -> Result<Diagnosis, Error> {
    let mut diagnosis = Diagnosis { node: session.node(), frames: 0, heard: BTreeMap::new(), health: None };
    session.observe(LISTEN, &mut |frame| {
        diagnosis.frames += 1;
        if let Some((node, state)) = parse_state_message(frame) {
            diagnosis.heard.insert(node, Some(state));
        } else if let Some(id) = frame.cob_id().map(|id| id.get()) {
            // Messages that a node sends: EMCY, PDO, SDO answers.
            let sent_by = matches!(id & 0x780, 0x080 | 0x180 | 0x280 | 0x380 | 0x480 | 0x580);
            if let Some(node) = NodeId::new((id & 0x7F) as u8).filter(|_| sent_by) {
                diagnosis.heard.entry(node).or_insert(None);
            }
        }
    })?;
    diagnosis.health = session.health();
    Ok(diagnosis)
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { node, frames, heard, health } = self;
        let is_echo = health.and_then(|health| health.trouble()) == Some(Trouble::Echo);
        if *frames == 0 || is_echo && heard.is_empty() {
            if let Some(advice) = health.and_then(|health| health.advice()) {
                return f.write_str(&advice);
            }
            if health.is_some_and(|health| health.acknowledged()) {
                return write!(
                    f,
                    "another node acknowledges the adapter's frames, so the bit rate is right: check that \
                     node {node} is the right one (coflash scan asks all of them, coflash lss fastscan finds devices without \
                     node-ID), and that it is switched on; coflash more catch catches a program that never answers while the \
                     device is switched off and on, or kept from starting by the entry strap"
                );
            }
            return write!(
                f,
                "nothing at all is heard on the bus: check that the device has power, that both sides use the same bit \
                 rate, and that cable and terminators are right; a device may also be silent because it has no node-ID \
                 (coflash lss fastscan), is off the bus (switch it off and on), or runs a program that never answers (coflash \
                 more catch holds it in the bootloader when it is switched on, and so does the entry strap)"
            );
        }
        self.traffic(f)?;
        match health.and_then(|health| health.disturbance()) {
            // Others may be heard although many of their frames are lost.
            Some(advice) => write!(f, "; besides, {advice}"),
            None => Ok(()),
        }
    }
}

/// What a node needs that is heard and does not answer. The tool does not look for the COB-IDs: a request on
/// one of a PDO would be a command to a machine.
const OTHER_IDS: &str = "another tool may be using it, it needs a longer --sdo-timeout, or SDO has other \
                         COB-IDs there: give --sdo-request and --sdo-response as its product has them \
                         (sdo.request_base, sdo.response_base)";

impl Diagnosis {
    /// The conclusion from the frames that were heard.
    fn traffic(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { node, heard, .. } = self;
        match heard.get(node) {
            Some(Some(NmtState::Stopped)) => write!(
                f,
                "node {node} sends heartbeats in state stopped, in which SDO does not work: coflash reset --node {node}"
            ),
            Some(Some(state)) => write!(
                f,
                "node {node} sends heartbeats ({}) but does not answer: {OTHER_IDS}",
                state_words(*state)
            ),
            Some(None) => write!(
                f,
                "node {node} sends frames but does not answer: {OTHER_IDS}"
            ),
            None if heard.is_empty() => write!(
                f,
                "the bus works, but no CANopen node sends frames: check that node {node} is the right one and that it has \
                 power; coflash scan asks all of them"
            ),
            None => {
                let nodes: Vec<String> = heard.keys().map(NodeId::to_string).collect();
                let are = if nodes.len() == 1 { ("node", "is") } else { ("nodes", "are") };
                write!(
                    f,
                    "the bus works, and {} {} {} heard: check that node {node} is the right one and that it has \
                     power; coflash scan asks all of them, coflash lss fastscan finds devices without node-ID",
                    are.0,
                    nodes.join(", "),
                    are.1
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// socketcand's error frames, of which class 004h does not tell the error.
    #[test]
    fn errors_of_the_bus_are_told_beside_the_frames_that_were_heard() {
        let node = NodeId::new(5).unwrap();
        let mut health = Health::default();
        let mut diagnosis = Diagnosis { node, frames: 0, heard: BTreeMap::new(), health: Some(health) };
        assert!(diagnosis.to_string().starts_with("nothing at all is heard"), "{diagnosis}");
        health.error_frame(0x004, &[]);
        diagnosis.health = Some(health);
        assert!(
            diagnosis.to_string().starts_with("the adapter has reported 1 error of the bus"),
            "{diagnosis}"
        );
        diagnosis.frames = 3;
        diagnosis.heard.insert(NodeId::new(9).unwrap(), None);
        let words = diagnosis.to_string();
        assert!(words.starts_with("the bus works, and node 9 is heard"), "{words}");
        assert!(words.contains("besides, the adapter has reported 1 error of the bus"), "{words}");
        // A missing acknowledgement is over when others are heard.
        let mut health = Health::default();
        health.unacknowledged = 7;
        diagnosis.health = Some(health);
        assert!(!diagnosis.to_string().contains("besides"), "{diagnosis}");
    }
}
