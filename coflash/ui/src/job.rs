//! The tasks of the engineer's page.

use std::sync::Arc;

use canopen::NodeId;
use serde::Deserialize;

use super::firmware::Loaded;
use super::state::{State, Update};
use coflash_core::device::lss::{BitRate, LssAddress};
use coflash_core::update::Password;

/// A task.
pub(super) enum Job {
    /// Search the nodes on the bus.
    Scan,
    /// Download the file into these devices.
    Update {
        nodes: Vec<NodeId>,
        file: Arc<Loaded>,
        program: u8,
        trial: bool,
        start: bool,
        /// The password of locked devices.
        unlock: Option<Password>,
    },
    /// A single step with one device.
    Step { node: NodeId, program: u8, step: Step },
    /// Find one of the devices without a node-ID.
    Fastscan,
    /// Set node-ID and bit rate of the device with this address.
    Assign { address: LssAddress, node: Option<NodeId>, bit_rate: Option<BitRate>, store: bool },
}

/// A single step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Step {
    /// 1F51h = 80h.
    CallBack,
    /// 1F51h = 83h.
    Release,
    /// 1F51h = 84h.
    Withhold,
    /// 1F51h = 3.
    Erase,
    /// 1F51h = 1.
    Start,
    /// 1F50h, read.
    ReadBack,
}

impl Job {
    /// Enters the task as the running one.
    pub(super) fn entered(&self, state: &mut State) {
        let (kind, words) = match self {
            Self::Scan => ("scan", "searching the bus".to_string()),
            Self::Update { nodes, file, .. } => {
                state.updates = nodes.iter().map(|node| Update::waiting(*node)).collect();
                let devices = if nodes.len() == 1 { "device" } else { "devices" };
                let what =
                    if file.shown.is_bootloader { "the renewal of the bootloader" } else { "the update" };
                ("update", format!("{what} of {} {devices} with {}", nodes.len(), file.shown.name))
            }
            Self::Step { node, program, step } => {
                let words = match step {
                    Step::CallBack => format!("calling node {node} back to its bootloader"),
                    Step::Release => format!("releasing program {program} of node {node} for autostart"),
                    Step::Withhold => format!("taking back the release of program {program} of node {node}"),
                    Step::Erase => format!("erasing program {program} of node {node}"),
                    Step::Start => format!("starting program {program} of node {node}"),
                    Step::ReadBack => format!("reading program {program} of node {node}"),
                };
                ("step", words)
            }
            Self::Fastscan => ("lss", "searching for a device without a node-ID".to_string()),
            Self::Assign { .. } => ("lss", "setting node-ID and bit rate".to_string()),
        };
        state.begin(kind, words);
    }
}
