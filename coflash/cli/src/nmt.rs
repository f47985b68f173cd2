//! `coflash nmt`: sends a command of network management.

use std::collections::BTreeMap;
use std::time::Duration;

use canopen::nmt::{parse_state_message, NmtCommand, NmtState};
use canopen::NodeId;
use clap::{Args, ValueEnum};
use coboot_can::decode::state_words;
use coflash_core::device::diagnose::LISTEN;
use coflash_core::device::listen;
use serde_json::json;

use super::context::Context;
use super::device::cancelled;
use super::output::Failure;
use super::values::{milliseconds, node_id};

/// Starts, stops or resets one or all nodes (NMT).
///
/// No device answers to NMT. The command therefore reports the heartbeat or the boot-up message
/// that follows; a device that does not come back after a reset is an error.
#[derive(Debug, Args)]
pub(super) struct Nmt {
    /// The command.
    #[arg(value_enum, value_name = "COMMAND")]
    command: Service,

    /// The device's node-ID, or all.
    #[arg(long, short = 'N', alias = "node_id", default_value = "1", value_parser = addressed, value_name = "1..127|all")]
    node: Addressed,

    /// How long to wait for boot-up messages, in milliseconds; the wait for a single device ends
    /// with its message.
    #[arg(long, default_value = "2000", value_parser = milliseconds, value_name = "MS", hide_short_help = true)]
    boot_timeout: Duration,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Service {
    /// Enter operational state: SDO and PDO work.
    Start,
    /// Enter stopped state: neither SDO nor PDO works.
    Stop,
    /// Enter pre-operational state: SDO works, PDO does not.
    PreOperational,
    /// Restart the device.
    Reset,
    /// Restart only the communication: a new node-ID takes effect.
    ResetCommunication,
}

/// The nodes that an NMT command addresses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Addressed {
    One(NodeId),
    All,
}

fn addressed(text: &str) -> Result<Addressed, String> {
    match text {
        "all" => Ok(Addressed::All),
        number => node_id(number).map(Addressed::One).map_err(|why| format!("{why}, or all")),
    }
}

impl Service {
    fn command(self) -> NmtCommand {
        match self {
            Self::Start => NmtCommand::Start,
            Self::Stop => NmtCommand::Stop,
            Self::PreOperational => NmtCommand::EnterPreOperational,
            Self::Reset => NmtCommand::ResetNode,
            Self::ResetCommunication => NmtCommand::ResetCommunication,
        }
    }

    /// The state in the heartbeat of a node that has carried out the command.
    fn leads_to(self) -> NmtState {
        match self {
            Self::Start => NmtState::Operational,
            Self::Stop => NmtState::Stopped,
            Self::PreOperational => NmtState::PreOperational,
            Self::Reset | Self::ResetCommunication => NmtState::Initialisation,
        }
    }
}

impl Nmt {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let node = match self.node {
            Addressed::One(node) => Some(node),
            Addressed::All => None,
        };
        let target = self.command.leads_to();
        let reset = target == NmtState::Initialisation;
        let mut adapter = context.open()?;
        adapter.send(&self.command.command().emit(node))?;
        // In most networks, heartbeats come once a second.
        let time = if reset { self.boot_timeout } else { LISTEN };
        let mut heard: BTreeMap<NodeId, NmtState> = BTreeMap::new();
        let what = if reset { "a boot-up message comes" } else { "a heartbeat comes" };
        let waiting = context.waiting(what);
        listen(&mut *adapter, time, &cancelled()?, &mut |frame| {
            let Some((from, state)) = parse_state_message(frame) else { return false };
            if node.is_none_or(|node| node == from) && (!reset || state == target) {
                heard.insert(from, state);
            }
            node.is_some_and(|node| heard.get(&node) == Some(&target))
        })?;
        drop(waiting);
        let nodes: Vec<_> = heard
            .iter()
            .map(|(node, state)| json!({ "node": node.get(), "state": state_words(*state), "confirmed": *state == target }))
            .collect();
        let name = self.command.to_possible_value().map(|value| value.get_name().to_string());
        let mut value = json!({ "service": name, "node": node.map(NodeId::get), "heard": nodes });
        let result = match node {
            Some(node) if reset && heard.is_empty() => Err(Failure::no_boot_up(node).within(&mut value)),
            _ => Ok(()),
        };
        context.result(self.words(node, &heard, reset), || value);
        result
    }

    fn words(&self, node: Option<NodeId>, heard: &BTreeMap<NodeId, NmtState>, reset: bool) -> String {
        let whom = node.map_or("all nodes".to_string(), |node| format!("node {node}"));
        let one = |(node, state): (&NodeId, &NmtState)| match reset {
            true => format!("node {node}"),
            false if *state == self.command.leads_to() => format!("node {node} is {}", state_words(*state)),
            false => format!("node {node} has not carried out the command and is {}", state_words(*state)),
        };
        let list = heard.iter().map(one).collect::<Vec<_>>().join(", ");
        match (reset, list.is_empty()) {
            (true, true) => format!("{whom}: command sent; no node has sent a boot-up message"),
            (true, false) => format!("back on the bus: {list}"),
            (false, true) => format!("{whom}: command sent; no heartbeat has shown its effect"),
            (false, false) => format!("{whom}: command sent; {list}"),
        }
    }
}
