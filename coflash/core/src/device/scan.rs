//! Finds the nodes on the bus.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::Duration;

use canopen::nmt::{parse_state_message, NmtState};
use canopen::program::DEVICE_TYPE;
use canopen::sdo::wire::Request;
use canopen::{AbortCode, Address, CobId, Frame, NodeId};

use super::error::Error;
use super::info::{info, DeviceInfo};
use super::listen::listen;
use super::session::{ensure_bus_alone, Session};
use super::timing::Timing;
use coboot_can::Adapter;

/// A node that answered or was heard.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Found {
    /// The last boot-up or heartbeat message heard.
    pub state: Option<NmtState>,
    /// Its SDO information, if it gives it.
    pub info: Option<DeviceInfo>,
    /// Why there is none of a node that answers, as the rest of a sentence after "answers, but".
    pub but: Option<String>,
}

options! {
    /// Options of a scan.
    #[derive(Clone, Debug)]
    pub struct ScanOptions {
        /// The node-IDs to ask.
        pub nodes: Vec<NodeId> = (1..=127).filter_map(NodeId::new).collect(),
        /// How long to listen for messages that nodes send by themselves; in most networks,
        /// heartbeats come once a second.
        pub listen: Duration = Duration::from_millis(1100),
        /// The time limits.
        pub timing: Timing = Timing::default(),
        /// Whether to send requests.
        pub ask: bool = true,
        /// Whether to listen first, and to ask nobody while another tool sends SDO requests: those
        /// of a scan would break its transfer.
        pub alone: bool = false,
    }
}

/// How many nodes are asked at the same time: every present node answers, and the adapter must not
/// lose answers.
const AT_ONCE: usize = 16;

/// Asks all nodes for their device type, and listens for messages that nodes send by themselves.
///
/// First it aborts a transfer that may be running with a node: within a block download, the device
/// could take a request for a segment and not answer it.
///
/// # Errors
/// [`Error::Adapter`] or [`Error::Cancelled`], and [`Error::NotAlone`] if that is [wanted](ScanOptions::alone); an
/// empty bus is not an error.
pub fn scan(
    adapter: &mut dyn Adapter,
    options: &ScanOptions,
    cancelled: &Arc<AtomicBool>,
) -> Result<BTreeMap<NodeId, Found>, Error> {
    if options.alone {
        ensure_bus_alone(adapter, cancelled)?;
    }
    let mut found: BTreeMap<NodeId, Found> = BTreeMap::new();
    let mut answered: Vec<NodeId> = Vec::new();
    if options.ask {
        let device_type = Address::new(DEVICE_TYPE, 0);
        let requests =
            [Request::Abort(device_type, AbortCode::GENERAL), Request::InitiateUpload(device_type)];
        for nodes in options.nodes.chunks(AT_ONCE) {
            for node in nodes {
                for request in &requests {
                    adapter.send(&Frame::of(CobId::sdo_request(*node), &request.emit()))?;
                }
            }
            let mut silent: Vec<NodeId> = nodes.to_vec();
            listen(adapter, options.timing.sdo.min(AT_ONCE_LIMIT), cancelled, &mut |frame| {
                note_state(&mut found, frame);
                let answering = silent.iter().position(|node| is_answer(frame, *node));
                answered.extend(answering.map(|at| silent.remove(at)));
                silent.is_empty()
            })?;
        }
    }
    listen(adapter, options.listen, cancelled, &mut |frame| {
        note_state(&mut found, frame);
        false
    })?;
    for node in answered {
        let mut session = Session::new(adapter, node, options.timing);
        session.cancel_by(cancelled.clone());
        let reported = info(&mut session);
        let found = found.entry(node).or_default();
        match reported {
            // The answers are a mixture of both.
            _ if session.is_answered_twice()? => {
                found.but = Some("so does a second device with this node-ID: switch one off".into())
            }
            Ok(reported) => found.info = Some(reported),
            Err(error @ (Error::Adapter(_) | Error::Cancelled)) => return Err(error),
            Err(error) => found.but = Some(but(&error)),
        }
    }
    Ok(found)
}

/// On a working bus, no node takes longer for the first answer.
const AT_ONCE_LIMIT: Duration = Duration::from_millis(200);

/// Whether the frame is an SDO answer of the node: also an abort, and also one that is too short.
fn is_answer(frame: &Frame, node: NodeId) -> bool {
    frame.cob_id() == Some(CobId::sdo_response(node))
}

/// What is wrong with the answers of a node, as the rest of a sentence after "answers, but".
fn but(error: &Error) -> String {
    match error {
        Error::NoAnswer { doing, .. } => format!("not to every request ({doing})"),
        Error::ShortAnswer { len, .. } => format!("with frames of {len} bytes where SDO has 8"),
        Error::Refused { doing, code, .. } => format!("refuses {doing}: abort {code}"),
        error => error.to_string(),
    }
}

fn note_state(found: &mut BTreeMap<NodeId, Found>, frame: &Frame) {
    if let Some((node, state)) = parse_state_message(frame) {
        found.entry(node).or_default().state = Some(state);
    }
}
