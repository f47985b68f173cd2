//! The search and the update of a station.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use canopen::NodeId;
use coboot_can::{wall, Link};
use coflash_core::device::lock::Lock;
use coflash_core::device::scan::ScanOptions;
use coflash_core::machine::{self, Plan, PlanError, RunOptions, Todo};
use coflash_core::update::{Event, FlashOptions, ManyOptions, Password};

use super::message::Message;
use super::report::{note_interrupted, unsaved, Entered, Of, Report};
use super::row::{note, rows, Row};
use super::station::{change, Stage, Station};
use super::trouble;
use crate::shared::{Shared, Work};
use crate::state::{self, Notice, Phase};

/// Search the devices of the package, and make a plan.
pub(super) struct Search(pub(super) Arc<Station>);

impl Work for Search {
    fn enter(&self, state: &mut state::State) {
        state.begin("scan", "searching the bus".to_owned());
        self.0.change(|own| {
            own.message = None;
            own.device_number.clear();
            own.stage = Stage::Searching;
        });
    }

    fn run(self: Box<Self>, link: &mut Link, shared: &Shared) -> Notice {
        let station = &self.0;
        match search(station, link, shared) {
            Ok(plan) => {
                if !plan.devices.is_empty() {
                    station.service.note_bus(&shared.read(|state| state.adapter.url.clone()));
                }
                change(shared, station, |own| {
                    own.plans += 1;
                    own.stage = Stage::Planned { number: own.plans, plan: Arc::new(plan) };
                });
                Notice::done("the bus was searched")
            }
            Err(message) => refused(station, shared, Stage::Waiting, message),
        }
    }
}

/// Keeps why a search or an update was not carried out. The page shows that, and not the notice.
fn refused(station: &Station, shared: &Shared, stage: Stage, message: Message) -> Notice {
    let notice = Notice::done(message.original());
    change(shared, station, |own| {
        own.device_number.clear();
        own.stage = stage;
        own.message = Some(message);
    });
    notice
}

fn search(station: &Station, link: &mut Link, shared: &Shared) -> Result<Plan, Message> {
    let Link::Bus(adapter) = link else { return Err(Message::new("gateway")) };
    let package = &station.service.package;
    // Before the scan, which ends the transfers of all nodes.
    let _locks = locked(shared, package.nodes())?;
    let scan = ScanOptions::default().alone(true);
    machine::plan(&mut **adapter, package, &scan, &shared.cancelled).map_err(|error| match error {
        PlanError::Bus(error) => trouble::of_error(&error),
        PlanError::Package(fault) => Message::new("two-programs").detail(&fault).number(fault.number()),
    })
}

/// Locks nodes among the programs of this computer.
fn locked(shared: &Shared, nodes: impl Iterator<Item = NodeId>) -> Result<BTreeMap<NodeId, Lock>, Message> {
    let mut locks = BTreeMap::new();
    let url = shared.read(|state| state.adapter.url.clone());
    Lock::more(&url, nodes, &mut locks).map_err(|error| trouble::of_error(&error))?;
    Ok(locks)
}

/// Carry out a plan that the user has confirmed.
pub(super) struct Update {
    pub(super) station: Arc<Station>,
    /// The plan as the user has seen it.
    pub(super) number: u64,
    pub(super) plan: Arc<Plan>,
    /// The devices that the user has chosen.
    pub(super) nodes: BTreeSet<NodeId>,
    /// The password of locked devices.
    pub(super) unlock: Option<Password>,
    pub(super) entered: Entered,
}

/// The plan for the chosen devices. Where no program is due, the older ones were chosen.
fn chosen(plan: &Plan, nodes: &BTreeSet<NodeId>) -> Plan {
    let mut plan = plan.clone();
    plan.devices.retain(|device| !is_due(device) || nodes.contains(&device.node));
    let due: BTreeSet<NodeId> = plan.nodes().collect();
    plan.allow_older(|node| !due.contains(&node));
    plan
}

/// Whether a plan has something that can be written to this device.
pub(super) fn is_due(device: &machine::Device) -> bool {
    device.steps.iter().any(|step| matches!(step.todo, Todo::Update | Todo::Older))
}

impl Update {
    /// The devices, with those that are written.
    fn rows(&self) -> Vec<Row> {
        let mut rows = rows(&self.plan);
        for row in &mut rows {
            let node = row.node.and_then(NodeId::new);
            row.choose(node.is_some_and(|node| self.nodes.contains(&node)));
        }
        rows
    }
}

impl Work for Update {
    fn enter(&self, state: &mut state::State) {
        state.begin("update", format!("the update with {}", self.station.service.file));
        state.updates = self.nodes.iter().map(|node| state::Update::waiting(*node)).collect();
        self.station.change(|own| {
            own.message = None;
            own.device_number.clone_from(&self.entered.device_number);
            own.stage = Stage::Working(self.rows());
        });
    }

    fn run(self: Box<Self>, link: &mut Link, shared: &Shared) -> Notice {
        let (station, mut rows) = (&self.station, self.rows());
        let service = &station.service;
        let back = || Stage::Planned { number: self.number, plan: self.plan.clone() };
        let Link::Bus(adapter) = link else {
            return refused(station, shared, back(), Message::new("gateway"));
        };
        // No device is changed whose outcome could not be kept, and none while an earlier one is not.
        if let Some(message) = station.save() {
            return refused(station, shared, back(), message);
        }
        // Each device has a report that its update has begun, and one of its end, which the machine's repeats.
        if let Err(error) = service.folder.check(3 * rows.len()) {
            return refused(station, shared, back(), unsaved(&error, service.folder.path()));
        }
        let _locks = match locked(shared, self.nodes.iter().copied()) {
            Ok(locks) => locks,
            Err(message) => return refused(station, shared, back(), message),
        };
        note_interrupted(&mut rows, &service.folder);
        let of = Arc::new(Of {
            date: wall().as_secs(),
            entered: self.entered.clone(),
            service: service.clone(),
            adapter: shared.read(|state| state.adapter.url.clone()),
            tool: format!("coflash {}", shared.tool),
            missing: self.plan.missing.iter().map(trouble::of_missing).collect(),
        });
        if let Some(message) = station.begin(&rows, &of) {
            return refused(station, shared, back(), message);
        }
        let on_event = |node: NodeId, _: usize, event: Event| {
            shared.record(node, &event);
            shared.change(|state| {
                if let Some(update) = state.updates.iter_mut().find(|update| update.node == node.get()) {
                    update.event(&event);
                }
            });
        };
        let many = ManyOptions::default().cancelled(shared.cancelled.clone());
        let options = RunOptions::default().flash(FlashOptions::default().unlock(self.unlock)).many(many);
        let outcomes = machine::run(
            &mut **adapter,
            &service.package,
            &chosen(&self.plan, &self.nodes),
            &options,
            &on_event,
        );
        note(&mut rows, &outcomes);
        station.change(|own| own.known.recall(&mut rows));
        if outcomes.iter().any(trouble::is_locked) {
            station.change(|own| own.asks_password = true);
        }
        station.keep(Report::of_all(&rows, &of));
        shared.change(|state| {
            for update in &mut state.updates {
                let row = rows.iter().find(|row| row.node == Some(update.node));
                let words = row.and_then(|row| row.trouble.as_ref()).map(Message::original);
                update.phase = if words.is_some() { Phase::Failed } else { Phase::Done };
                update.words = words.unwrap_or_else(|| "updated".to_owned());
            }
            station.change(|own| own.stage = Stage::Ended(rows));
        });
        // How it went is in the rows.
        Notice::done("the update has ended")
    }
}

#[cfg(test)]
mod tests {
    use coflash_core::machine::{Device, Step};

    use super::super::row::RowState;
    use super::*;

    /// Nodes 5 and 7 have a newer first program and an old second one, node 6 newer ones of both.
    #[test]
    fn of_older_programs_those_are_written_that_were_chosen() {
        let [five, six, seven] = [5, 6, 7].map(|node| NodeId::new(node).unwrap());
        let step = |entry, todo| {
            let (program, to) = (String::new(), String::new());
            Step { entry, program, from: None, to, todo, every_version_has_this_crc: false, older: false }
        };
        let device = |(node, todos): (NodeId, [Todo; 2])| {
            let steps = (0..).zip(todos).map(|(entry, todo)| step(entry, todo)).collect();
            Device { node, name: None, identity: [None; 4], steps }
        };
        let mixed = || [Todo::Older, Todo::Update];
        let devices = [(five, mixed()), (six, [Todo::Older, Todo::Older]), (seven, mixed())].map(device);
        let plan = Plan { devices: devices.into(), missing: Vec::new(), foreign: Vec::new() };
        let states = |rows: &[Row]| {
            rows.iter().map(|row| (row.state, row.steps[0].state, row.steps[1].state)).collect::<Vec<_>>()
        };
        let (due, older) = (RowState::Due, RowState::Older);
        let mut rows = rows(&plan);
        assert_eq!(states(&rows), [(due, older, due), (older, older, older), (due, older, due)]);
        let nodes = BTreeSet::from([five, six]);
        rows.iter_mut().for_each(|row| row.choose(row.node != Some(7)));
        let (waits, out) = (RowState::Waiting, RowState::LeftOut);
        assert_eq!(states(&rows), [(waits, out, waits), (waits, waits, waits), (out, out, out)]);
        let written = chosen(&plan, &nodes).devices.into_iter().map(|device| {
            (device.node, device.steps.into_iter().map(|step| step.todo == Todo::Update).collect::<Vec<_>>())
        });
        assert_eq!(written.collect::<Vec<_>>(), [(five, vec![false, true]), (six, vec![true, true])]);
    }
}
