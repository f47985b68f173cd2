//! The search and the update of a station.

use std::collections::BTreeSet;
use std::sync::Arc;

use canopen::NodeId;
use coboot_can::{wall, Link};
use coflash_core::device::lock::Lock;
use coflash_core::device::scan::ScanOptions;
use coflash_core::machine::{self, Plan, PlanError, RunOptions, Todo};
use coflash_core::update::{Event, FlashOptions, ManyOptions, Password};
use coflash_core::Error;

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
    let named = package.programs().flat_map(|(entry, _)| &entry.nodes);
    let _locks = locked(shared, named.filter_map(|node| NodeId::new(*node)))?;
    let scan = ScanOptions::default().alone(true);
    machine::plan(&mut **adapter, package, &scan, &shared.cancelled).map_err(|error| match error {
        PlanError::Bus(error) => trouble::of_error(&error),
        PlanError::Package(fault) => Message::new("two-programs").detail(&fault).number(fault.number()),
    })
}

/// Locks nodes among the programs of this computer.
fn locked(shared: &Shared, nodes: impl Iterator<Item = NodeId>) -> Result<Vec<Lock>, Message> {
    let url = shared.read(|state| state.adapter.url.clone());
    let nodes: BTreeSet<NodeId> = nodes.collect();
    let locks: Result<Vec<Lock>, Error> = nodes.into_iter().map(|node| Lock::of(&url, node)).collect();
    locks.map_err(|error| trouble::of_error(&error))
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

    /// The plan for the chosen devices.
    fn chosen(&self) -> Plan {
        let Plan { devices, missing, foreign } = (*self.plan).clone();
        let is_in = |device: &machine::Device| !is_due(device) || self.nodes.contains(&device.node);
        let mut plan = Plan { devices: devices.into_iter().filter(is_in).collect(), missing, foreign };
        // The user has chosen them.
        plan.allow_older(|_| true);
        plan
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
        let outcomes = machine::run(&mut **adapter, &service.package, &self.chosen(), &options, &on_event);
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
