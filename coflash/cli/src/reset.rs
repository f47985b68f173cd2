//! `coflash reset`: NMT reset node or reset communication.

use std::time::Duration;

use canopen::nmt::{parse_state_message, NmtCommand, NmtState};
use canopen::NodeId;
use clap::Args;
use coflash_core::device::listen;
use serde_json::json;

use super::context::Context;
use super::device::cancelled;
use super::output::Failure;
use super::values::{milliseconds, node_id};

/// Resets one or all devices, and shows which come back.
///
/// After a reset a device starts its program if the program is released for autostart and the
/// device's autostart is enabled.
#[derive(Debug, Args)]
pub(super) struct Reset {
    /// The device's node-ID.
    #[arg(long, short = 'N', alias = "node_id", value_parser = node_id, value_name = "1..127", required_unless_present = "all")]
    node: Option<NodeId>,

    /// All devices of the bus.
    #[arg(long, conflicts_with = "node")]
    all: bool,

    /// Reset only the communication: a new node-ID takes effect.
    #[arg(long)]
    communication: bool,

    /// How long to wait for boot-up messages, in milliseconds.
    #[arg(long, default_value = "2000", value_parser = milliseconds, value_name = "MS", hide_short_help = true)]
    boot_timeout: Duration,
}

impl Reset {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let command = if self.communication { NmtCommand::ResetCommunication } else { NmtCommand::ResetNode };
        // A node-ID from the configuration file does not exclude --all.
        let node = self.node.filter(|_| !self.all);
        let mut adapter = context.open()?;
        adapter.send(&command.emit(node))?;
        let mut back: Vec<NodeId> = Vec::new();
        let waiting = context.waiting("a boot-up message comes");
        listen(&mut *adapter, self.boot_timeout, &cancelled()?, &mut |frame| {
            if let Some((node, NmtState::Initialisation)) = parse_state_message(frame) {
                if !back.contains(&node) {
                    back.push(node);
                }
            }
            // A device with a new node-ID comes back under that one. The wait ends early only for
            // the node-ID that was reset.
            node.is_some_and(|node| back.contains(&node))
        })?;
        drop(waiting);
        let words = match back.as_slice() {
            [] => "no node has sent a boot-up message".to_string(),
            nodes => {
                let nodes: Vec<String> = nodes.iter().map(NodeId::to_string).collect();
                format!("back on the bus: node {}", nodes.join(", "))
            }
        };
        let booted: Vec<u8> = back.iter().map(|node| node.get()).collect();
        let mut value = json!({ "node": node.map(NodeId::get), "booted": booted });
        let result = match node {
            Some(node) if back.is_empty() => Err(Failure::no_boot_up(node).within(&mut value)),
            _ => Ok(()),
        };
        context.result(words, || value);
        result
    }
}
