//! `coflash scan`: lists the nodes on the bus.

use std::collections::BTreeMap;
use std::time::Duration;

use canopen::program::ProgramState;
use canopen::NodeId;
use clap::Args;
use coboot_can::decode::state_words;
use coflash_core::device::info::ProgramInfo;
use coflash_core::device::scan::{scan, Found, ScanOptions};
use coflash_core::device::Timing;
use serde_json::{json, Value};

use super::context::Context;
use super::device::cancelled;
use super::output::Failure;
use super::units::table;
use super::values::{milliseconds, nodes};

/// Lists the nodes on the bus.
///
/// It sends an SDO request to each node-ID, and listens for heartbeats.
///
/// It aborts an SDO transfer that another tool is running or has left unfinished; --listen-only
/// sends no requests.
#[derive(Debug, Args)]
pub(super) struct Scan {
    /// The node-IDs to ask, with ranges, like 1,5,9-12.
    #[arg(long, short = 'N', alias = "node", value_parser = nodes, value_name = "NODES", default_value = "1-127")]
    nodes: Vec<Vec<NodeId>>,

    /// How long to listen, in milliseconds.
    #[arg(long, value_parser = milliseconds, value_name = "MS", default_value = "1100")]
    listen: Duration,

    /// Send no requests.
    #[arg(long)]
    listen_only: bool,

    /// How long the answer to one request may take, in milliseconds.
    #[arg(long, alias = "sdo_timeout", default_value = "500", value_parser = milliseconds, value_name = "MS")]
    sdo_timeout: Duration,
}

impl Scan {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let options = ScanOptions::default()
            .nodes(self.nodes.concat())
            .listen(self.listen)
            .timing(Timing::default().sdo(self.sdo_timeout))
            .ask(!self.listen_only);
        let mut adapter = context.open()?;
        context.out.detail("sending requests to the nodes, and listening");
        let waiting = context.waiting("all nodes were asked, and had time to answer");
        let found = scan(&mut *adapter, &options, &cancelled()?)?;
        drop(waiting);
        let advice = match found.is_empty() {
            true => adapter.health().and_then(|health| health.advice()),
            false => None,
        };
        let asked = |node: &NodeId| options.ask && options.nodes.contains(node);
        let table = Table { found: &found, asked: &asked, advice: advice.as_deref() };
        context.result(table, || json!({ "nodes": values(&found, &asked), "advice": advice }));
        Ok(())
    }
}

/// A line for each node.
struct Table<'f> {
    found: &'f BTreeMap<NodeId, Found>,
    /// Whether a node was asked.
    asked: &'f dyn Fn(&NodeId) -> bool,
    /// The reason why no node answered, if it is known.
    advice: Option<&'f str>,
}

impl std::fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.found.is_empty() {
            return match self.advice {
                Some(advice) => write!(f, "no node answers, and no node was heard: {advice}"),
                None => f.write_str(
                    "no node answers, and no node was heard (coflash lss fastscan finds devices without node-ID)",
                ),
            };
        }
        let heads = ["node", "runs", "name", "software", "serial", "program", "heartbeat"];
        let rows = self.found.iter().map(|(node, found)| row(node, found, (self.asked)(node)));
        let rows = std::iter::once(heads.map(String::from)).chain(rows).collect::<Vec<_>>();
        f.write_str(&table(&rows))
    }
}

fn row(node: &NodeId, found: &Found, asked: bool) -> [String; 7] {
    let none = || "-".to_string();
    let state = found.state.map_or_else(none, |state| state_words(state).to_string());
    let node = node.to_string();
    let Some(info) = &found.info else {
        let runs = match &found.but {
            Some(but) => format!("answers, but {but}"),
            None if asked => "no answer".to_string(),
            None => "not asked".to_string(),
        };
        return [node, runs, none(), none(), none(), none(), state];
    };
    let who = if info.device_type.is_bootloader() { "bootloader" } else { "application" };
    let is_sealed = info.security.as_ref().is_some_and(|security| security.sealed);
    let runs = if is_sealed { format!("{who}, sealed") } else { who.to_string() };
    let text = |text: &Option<String>| text.clone().unwrap_or_else(none);
    let serial = info.identity[3].map_or_else(none, |serial| format!("{serial:08X}h"));
    let program = match info.programs.as_slice() {
        [] => none(),
        [program] => cell(program),
        programs => {
            let cells = programs.iter().map(|program| format!("{} {}", program.number, cell(program)));
            cells.collect::<Vec<_>>().join("; ")
        }
    };
    [node, runs, text(&info.name), text(&info.software_version), serial, program, state]
}

/// A program in one cell: the state from 1F51h, the CRC from 1F56h, and its version.
fn cell(program: &ProgramInfo) -> String {
    if program.status.is_some_and(|status| status.busy) {
        return "busy".to_string();
    }
    let state = match program.state() {
        Some(ProgramState::Absent) => return "none".to_string(),
        Some(ProgramState::Running) => "running",
        Some(ProgramState::Stopped) => "stopped",
        None => "-",
    };
    let crc = program.crc.filter(|crc| *crc != 0).map(|crc| format!(", CRC {crc:08X}h"));
    let version = program.release().map(|version| format!(", {version}"));
    format!("{state}{}{}", crc.unwrap_or_default(), version.unwrap_or_default())
}

fn values(found: &BTreeMap<NodeId, Found>, asked: &dyn Fn(&NodeId) -> bool) -> Vec<Value> {
    let value = |(node, found): (&NodeId, &Found)| {
        json!({
            "node": node.get(),
            "state": found.state.map(state_words),
            "answers": asked(node).then_some(found.info.is_some() || found.but.is_some()),
            "but": found.but,
            "info": found.info,
        })
    };
    found.iter().map(value).collect()
}
