//! The plan: the devices of a bus, matched with the programs of a package. To make it changes nothing.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;

use canopen::program::ProgramState;
use canopen::NodeId;
use serde::{Serialize, Serializer};

use super::fault::{DeviceFault, Fault};
use super::manifest::Entry;
use super::package::{version, Package};
use crate::device::info::{self, hex, program_info, DeviceInfo, ProgramInfo};
use crate::device::scan::{scan, Found, ScanOptions};
use crate::device::{Error, Session};
use crate::json;
use crate::update::{Installed, Marks, Payload};
use coboot_can::Adapter;

/// Why there is no plan.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The bus.
    #[error("{0}")]
    Bus(#[from] Error),
    /// The package has two programs for one of the nodes.
    #[error("the package {0}")]
    Package(#[from] Fault),
}

/// The plan of an update.
#[derive(Clone, Debug, Serialize)]
pub struct Plan {
    /// The devices that the package is for, by their node-IDs.
    pub devices: Vec<Device>,
    /// What the package names and the bus does not have.
    pub missing: Vec<Missing>,
    /// Nodes that nothing of the package is for. Nothing is done with them.
    pub foreign: Vec<Foreign>,
}

/// A device, and the programs for it.
#[derive(Clone, Debug, Serialize)]
pub struct Device {
    /// Its node-ID.
    #[serde(serialize_with = "json::node")]
    pub node: NodeId,
    /// 1008h, device name.
    pub name: Option<String>,
    /// 1018h/1 to 4.
    #[serde(flatten, serialize_with = "info::identity_fields")]
    pub identity: info::Identity,
    /// The programs, in the order of the update.
    pub steps: Vec<Step>,
}

/// A program of a device.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// The program: its place in the package.
    #[serde(skip)]
    pub entry: usize,
    /// Its name.
    pub program: String,
    /// The version or the CRC of what the device has, if it has a program.
    pub from: Option<String>,
    /// The same of the program in the package.
    pub to: String,
    /// What is to be done.
    #[serde(serialize_with = "todo_name")]
    pub todo: Todo,
    /// Whether the device reports the CRC of the program, and that is the CRC of each of its versions: the program
    /// is written, because nobody knows whether the device has it.
    pub every_version_has_this_crc: bool,
    /// Whether the device has a newer version.
    pub older: bool,
}

/// What is to be done with a program of a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Todo {
    /// Nothing: the device has the program.
    Has,
    /// The device gets it.
    Update,
    /// Nothing, unless the user wants it: the device has a newer version.
    Older,
    /// Nothing: the device is not the one of the package.
    Leave(DeviceFault),
}

/// What the package names and the bus does not have.
#[derive(Clone, Debug, Serialize)]
pub struct Missing {
    /// The program: its place in the package.
    #[serde(skip)]
    pub entry: usize,
    /// Its name.
    pub program: String,
    /// The node, if the package names it.
    #[serde(serialize_with = "some_node")]
    pub node: Option<NodeId>,
    /// What is missing.
    #[serde(serialize_with = "json::words")]
    pub fault: DeviceFault,
}

/// A node that nothing of the package is for.
#[derive(Clone, Debug, Serialize)]
pub struct Foreign {
    /// Its node-ID.
    #[serde(serialize_with = "json::node")]
    pub node: NodeId,
    /// What it is.
    #[serde(serialize_with = "json::words")]
    pub what: Stranger,
}

/// What a node is that nothing of the package is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Stranger {
    /// A device that has said what it is.
    Device {
        /// 1008h, device name.
        name: Option<String>,
        /// 1018h/1 to 4.
        identity: info::Identity,
    },
    /// It does not answer.
    Silent,
    /// It answers, but not as a device has to.
    Mute {
        /// What is wrong, as the rest of a sentence after "answers, but".
        but: String,
    },
}

impl Todo {
    /// Its stable name for programs.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Has => "has",
            Self::Update => "update",
            Self::Older => "older",
            Self::Leave(_) => "leave",
        }
    }
}

fn todo_name<S: Serializer>(todo: &Todo, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(todo.name())
}

fn some_node<S: Serializer>(node: &Option<NodeId>, serializer: S) -> Result<S::Ok, S::Error> {
    node.map(NodeId::get).serialize(serializer)
}

/// Scans the bus, and matches its nodes with the programs of the package.
///
/// # Errors
/// [`PlanError::Bus`] if the bus fails or the user cancels, [`PlanError::Package`] for a node that two
/// programs of the package are for.
pub fn plan(
    adapter: &mut dyn Adapter,
    package: &Package,
    options: &ScanOptions,
    cancelled: &Arc<AtomicBool>,
) -> Result<Plan, PlanError> {
    let found = scan(adapter, options, cancelled)?;
    let mut plan = matched(package, &found)?;
    // The CRC of a bootloader and the date of a program are not among the information about a device.
    for device in &mut plan.devices {
        let Some(info) = found.get(&device.node).and_then(|found| found.info.as_ref()) else { continue };
        for step in &mut device.steps {
            let of_step = package.program(step.entry).zip(package.marks(step.entry));
            let Some(((entry, new), marks)) = of_step else { continue };
            let mut session = Session::new(&mut *adapter, device.node, options.timing);
            session.cancel_by(cancelled.clone());
            let asked = match (&step.todo, info.bootloader.as_ref().filter(|_| new.is_bootloader())) {
                (Todo::Update | Todo::Older, Some(bootloader)) => {
                    program_info(&mut session, bootloader.number)
                        .map(|has| has_bootloader(info, &has, new).then_some(Todo::Has))
                }
                (Todo::Has, None) => marks
                    .is_of_other_date(&mut session, entry.program)
                    .map(|is_other| is_other.then_some(Todo::Update)),
                _ => Ok(None),
            };
            match asked {
                Ok(todo) => step.todo = todo.unwrap_or(step.todo.clone()),
                Err(error @ (Error::Adapter(_) | Error::Cancelled)) => return Err(error.into()),
                // The run asks a device again that answers no more, and says so.
                Err(_) => {}
            }
        }
    }
    Ok(plan)
}

/// Matches the nodes of a scan with the programs of the package.
///
/// # Errors
/// [`Fault::TwoPrograms`].
pub fn matched(package: &Package, found: &BTreeMap<NodeId, Found>) -> Result<Plan, Fault> {
    let mut plan = Plan { devices: Vec::new(), missing: Vec::new(), foreign: Vec::new() };
    for (node, found) in found {
        let Some(info) = &found.info else {
            let what = found.but.clone().map_or(Stranger::Silent, |but| Stranger::Mute { but });
            plan.foreign.push(Foreign { node: *node, what });
            continue;
        };
        let steps = steps(package, *node, info)?;
        if steps.is_empty() {
            plan.foreign.push(Foreign {
                node: *node,
                what: Stranger::Device { name: info.name.clone(), identity: info.identity },
            });
        } else {
            let (name, identity) = (info.name.clone(), info.identity);
            plan.devices.push(Device { node: *node, name, identity, steps });
        }
    }
    for (entry, (row, _)) in package.programs().enumerate() {
        let mut miss = |node, fault| {
            plan.missing.push(Missing { entry, program: row.name.clone(), node, fault });
        };
        for node in row.nodes.iter().filter_map(|node| NodeId::new(*node)) {
            if !plan.devices.iter().any(|device| device.node == node) {
                let but = found.get(&node).and_then(|found| found.but.clone());
                let absent = DeviceFault::Absent { node };
                miss(Some(node), but.map_or(absent, |but| DeviceFault::Mute { node, but }));
            }
        }
        let devices = plan.devices.iter().flat_map(|device| &device.steps);
        let count = devices.filter(|step| step.entry == entry).count();
        match row.count.map(usize::from) {
            Some(expected) if count < expected => {
                miss(None, DeviceFault::TooFew { program: row.name.clone(), expected, found: count });
            }
            _ => {}
        }
    }
    let is_missing = |node: NodeId| plan.missing.iter().any(|missing| missing.node == Some(node));
    // It is said once.
    plan.foreign.retain(|foreign| !is_missing(foreign.node));
    Ok(plan)
}

/// The programs of the package for this device.
fn steps(package: &Package, node: NodeId, info: &DeviceInfo) -> Result<Vec<Step>, Fault> {
    let number = |step: &Step| package.program(step.entry).map(|(entry, _)| entry.program);
    let mut steps: Vec<Step> = Vec::new();
    for (at, (entry, program)) in package.programs().enumerate() {
        let is_named = entry.nodes.contains(&node.get());
        let installed = package.marks(at).map_or(Installed::Other, |marks| has(info, entry, marks));
        let todo = match differs(entry, program, node, info) {
            _ if !is_named && !entry.nodes.is_empty() => continue,
            Some(_) if !is_named => continue,
            Some(fault) => Todo::Leave(fault),
            None if installed == Installed::This => Todo::Has,
            None if is_older(info, entry, program, package.marks(at)) => Todo::Older,
            None => Todo::Update,
        };
        let same = |step: &&Step| number(step) == Some(entry.program) && !matches!(step.todo, Todo::Leave(_));
        if let (Some(first), false) = (steps.iter().find(same), matches!(todo, Todo::Leave(_))) {
            return Err(Fault::TwoPrograms {
                first: first.program.clone(),
                second: entry.name.clone(),
                number: entry.program,
                whom: format!("node {node}"),
            });
        }
        let (from, to) = versions(info, entry, program);
        let every_version_has_this_crc = installed == Installed::Unknown && todo == Todo::Update;
        let older = todo == Todo::Older;
        steps.push(Step {
            entry: at,
            program: entry.name.clone(),
            from,
            to,
            todo,
            every_version_has_this_crc,
            older,
        });
    }
    // A package may have a program for each device that can be at a node.
    let served: Vec<Option<u8>> =
        steps.iter().filter(|step| !matches!(step.todo, Todo::Leave(_))).map(number).collect();
    steps.retain(|step| !matches!(step.todo, Todo::Leave(_)) || !served.contains(&number(step)));
    Ok(steps)
}

/// The part of the identity in which a device differs from the package, or from what the file itself names.
fn differs(entry: &Entry, program: &Payload, node: NodeId, info: &DeviceInfo) -> Option<DeviceFault> {
    let of_entry = entry.identity.and_then(|wanted| {
        let parts = [
            ("vendor-ID", Some(wanted.vendor)),
            ("product code", Some(wanted.product)),
            ("revision", wanted.revision),
        ];
        let mut parts = parts.into_iter().zip(info.identity);
        let other = parts.find(|((_, wanted), device)| wanted.is_some() && wanted != device)?;
        Some((other.0 .0, other.1, other.0 .1))
    });
    let of_file = || program.misfit(info.identity);
    let of_file = || of_file().map(|(what, device, file)| (what.words(), Some(device), Some(file)));
    let (what, device, wanted) = of_entry.or_else(of_file)?;
    let (device, package) = (hex(device), hex(wanted));
    Some(DeviceFault::OtherDevice { node, program: entry.name.clone(), what, device, package })
}

/// What the device reports about the program of this number, if it has one.
fn installed<'i>(info: &'i DeviceInfo, entry: &Entry) -> Option<&'i ProgramInfo> {
    let installed = info.programs.iter().find(|installed| installed.number == entry.program);
    installed.filter(|installed| installed.state() != Some(ProgramState::Absent))
}

/// Whether the device runs with this program. One in its bootloader has not been released yet.
fn has(info: &DeviceInfo, entry: &Entry, marks: &Marks) -> Installed {
    let installed = installed(info, entry).filter(|_| !info.device_type.is_bootloader());
    installed.map_or(Installed::Other, |installed| marks.compare(installed))
}

/// Whether the device has a newer version.
fn is_older(info: &DeviceInfo, entry: &Entry, program: &Payload, marks: Option<&Marks>) -> bool {
    match (program.bootloader(), info.bootloader) {
        // Major in the upper half, minor in the lower; a sealed one may have none.
        (Some(new), Some(old)) => new.0 != 0 && new.0 < old.version.0,
        (Some(_), None) => false,
        (None, _) => marks.zip(installed(info, entry)).is_some_and(|(marks, has)| marks.is_older(has)),
    }
}

/// Whether the device has this bootloader. The CRC of a sealed one is not known here, and an application
/// need not report any: then the version decides.
fn has_bootloader(info: &DeviceInfo, has: &ProgramInfo, new: &Payload) -> bool {
    let Some(old) = info.bootloader else { return false };
    // One on trial has to be confirmed.
    let is_settled =
        old.running.is_none_or(|running| running.progress.state != shared_abi::renewal::State::Staged);
    let is_same_crc = match (new, has.crc) {
        (Payload::Bootloader(_), Some(crc)) if crc != 0 => crc == new.crc(),
        _ => true,
    };
    is_settled && is_same_crc && Some(old.version) == new.bootloader()
}

/// What the device has and what it gets: their versions, if both have one and these differ, and otherwise
/// their CRCs.
fn versions(info: &DeviceInfo, entry: &Entry, program: &Payload) -> (Option<String>, String) {
    let installed = installed(info, entry);
    let has = match info.bootloader.filter(|_| entry.is_bootloader()) {
        Some(bootloader) => Some(bootloader.version.to_string()),
        None => installed.and_then(ProgramInfo::release).map(|version| version.to_string()),
    };
    let crc = |crc: u32| format!("CRC {crc:08X}h");
    match (has, version(program)) {
        (Some(has), Some(gets)) if has != gets || entry.is_bootloader() => (Some(has), gets),
        (None, Some(gets)) if installed.is_none() => (None, gets),
        _ => (installed.and_then(|it| it.crc).filter(|crc| *crc != 0).map(crc), crc(program.crc())),
    }
}

impl Plan {
    /// How many programs are written.
    #[must_use]
    pub fn updates(&self) -> usize {
        let steps = self.devices.iter().flat_map(|device| &device.steps);
        steps.filter(|step| step.todo == Todo::Update).count()
    }

    /// Also writes what is older than what these devices have.
    pub fn allow_older(&mut self, is_allowed: impl Fn(NodeId) -> bool) {
        for device in self.devices.iter_mut().filter(|device| is_allowed(device.node)) {
            let older = device.steps.iter_mut().filter(|step| step.todo == Todo::Older);
            older.for_each(|step| step.todo = Todo::Update);
        }
    }

    /// Whether each device at the nodes of the package is another one than there: this is another machine.
    #[must_use]
    pub fn is_of_other_machine(&self) -> bool {
        let mut steps = self.devices.iter().flat_map(|device| &device.steps).peekable();
        let is_other = |step: &Step| matches!(step.todo, Todo::Leave(DeviceFault::OtherDevice { .. }));
        steps.peek().is_some() && steps.all(is_other)
    }

    /// The devices that are changed.
    pub fn nodes(&self) -> impl Iterator<Item = NodeId> + '_ {
        let is_changed = |device: &&Device| device.steps.iter().any(|step| step.todo == Todo::Update);
        self.devices.iter().filter(is_changed).map(|device| device.node)
    }
}

impl fmt::Display for Stranger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Device { name, identity } => {
                let [vendor, product, ..] = identity.map(hex);
                let name = name.as_ref().map_or(String::new(), |name| format!("{name}, "));
                write!(f, "{name}vendor {vendor}, product {product}")
            }
            Self::Silent => f.write_str("it does not answer"),
            Self::Mute { but } => write!(f, "it answers, but {but}"),
        }
    }
}

/// Why a program is written whose CRC the device reports.
pub const EVERY_VERSION_HAS_THIS_CRC: &str =
    "each version of this program may have this CRC, because it has a CRC-32 of \
     its own: nobody knows whether the device has it, so it is written";

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_of_other_machine() {
            writeln!(f, "this is not the machine of this package")?;
        }
        for device in &self.devices {
            let serial =
                device.identity[3].map_or(String::new(), |serial| format!(" (serial number {serial:08X}h)"));
            for Step { program, from, to, todo, every_version_has_this_crc, older, .. } in &device.steps {
                write!(f, "node {}: {program}: ", device.node)?;
                let from = from.as_deref().unwrap_or("no program");
                match todo {
                    Todo::Has => writeln!(f, "it has {to}{serial}")?,
                    Todo::Update if *older => writeln!(f, "{from} -> {to}, which is older{serial}")?,
                    Todo::Update => writeln!(f, "{from} -> {to}{serial}")?,
                    Todo::Older => writeln!(f, "it has {from}, and {to} is older: not written{serial}")?,
                    Todo::Leave(fault) => writeln!(f, "is not written: {fault}")?,
                }
                if *every_version_has_this_crc {
                    writeln!(f, "  warning: {EVERY_VERSION_HAS_THIS_CRC}")?;
                }
            }
        }
        for Missing { program, fault, .. } in &self.missing {
            writeln!(f, "{program}: {fault}")?;
        }
        for Foreign { node, what } in &self.foreign {
            writeln!(f, "node {node}: not in the package, and left alone: {what}")?;
        }
        Ok(())
    }
}
