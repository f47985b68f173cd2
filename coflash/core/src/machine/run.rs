//! The run: carries out a plan, program by program in the order of the package.

use std::collections::BTreeSet;
use std::sync::atomic::Ordering;

use canopen::NodeId;

use super::fault::DeviceFault;
use super::manifest::Entry;
use super::package::Package;
use super::plan::{Device, Plan, Todo};
use crate::device::info::{hex, identity};
use crate::device::{Error, Session};
use crate::file::Target;
use crate::update::event::Event;
use crate::update::many::{flash_many, Failed, Job, ManyOptions};
use crate::update::{DeviceAfterUpdate, DeviceAnswer, DeviceState, FlashOptions, Known, Payload, Report};
use coboot_can::Adapter;

options! {
    /// The options of a run.
    #[derive(Clone, Debug)]
    pub struct RunOptions {
        /// The options for all devices. What the package says wins.
        pub flash: FlashOptions = FlashOptions::default(),
        /// How devices with the same program are updated at the same time.
        pub many: ManyOptions = ManyOptions::default(),
        /// What is known of the devices from an earlier run that did not end.
        pub known: Known = Known::default(),
    }
}

/// The outcome of a program of a device, or of what is missing.
#[derive(Debug)]
#[non_exhaustive]
pub struct Outcome {
    /// The device; `None` if the package does not name it.
    pub node: Option<NodeId>,
    /// The program: its place in the package.
    pub entry: usize,
    /// What became of it.
    pub result: Result<Good, Bad>,
}

/// A good outcome.
#[derive(Clone, Copy, Debug)]
pub enum Good {
    /// The device had the program before.
    Had,
    /// The device got it.
    Updated(Report),
}

/// A bad outcome.
#[derive(Debug)]
pub enum Bad {
    /// The device was not begun.
    Left(DeviceFault),
    /// The update failed.
    Failed(Failed),
}

/// Carries out a plan. The programs are written in the order of the package, each to all of its devices, which
/// are updated together where they can. Before that, the identity of each device is compared with the plan
/// again. If one fails, the others go on; a device gets nothing more after a program that failed.
///
/// `on_event` gets the events of each device, on separate threads. The outcomes are in the order of the package.
/// An interrupted run is continued by a new plan: devices that have their program are not written again, and
/// a download that was cut off goes on.
pub fn run(
    adapter: &mut dyn Adapter,
    package: &Package,
    plan: &Plan,
    options: &RunOptions,
    on_event: &(dyn Fn(NodeId, usize, Event) + Sync),
) -> Vec<Outcome> {
    let mut failed: BTreeSet<NodeId> = BTreeSet::new();
    // The devices of which a program was changed: of the others it is not said that the device was not.
    let mut changed: BTreeSet<NodeId> = BTreeSet::new();
    let mut outcomes = Vec::new();
    for (at, (entry, program)) in package.programs().enumerate() {
        let missing = plan.missing.iter().filter(|missing| missing.entry == at);
        outcomes.extend(missing.map(|missing| {
            let (node, result) = (missing.node, Err(Bad::Left(missing.fault.clone())));
            Outcome { node, entry: at, result }
        }));
        let mut due: Vec<(NodeId, Target)> = Vec::new();
        let mut ended: Vec<(NodeId, Result<Good, Bad>)> = Vec::new();
        for device in &plan.devices {
            for step in device.steps.iter().filter(|step| step.entry == at) {
                let (node, program) = (device.node, entry.name.clone());
                match &step.todo {
                    // Another machine may be on the bus since then.
                    Todo::Has => match is_the_same(adapter, entry, device, options) {
                        // Not compared again: the plan counts.
                        Ok(_) | Err(Bad::Failed(Failed { error: Error::Cancelled, .. })) => {
                            ended.push((node, Ok(Good::Had)));
                        }
                        Err(bad) => ended.push((node, Err(bad))),
                    },
                    Todo::Older => {
                        let (has, gets) = (step.from.clone().unwrap_or_default(), step.to.clone());
                        ended.push((node, Err(Bad::Left(DeviceFault::Older { node, program, has, gets }))));
                    }
                    Todo::Leave(fault) => ended.push((node, Err(Bad::Left(fault.clone())))),
                    Todo::Update if failed.contains(&node) => {
                        ended.push((node, Err(Bad::Left(DeviceFault::EarlierFailed { node, program }))));
                    }
                    Todo::Update => match is_the_same(adapter, entry, device, options) {
                        Ok(target) => due.push((node, target)),
                        Err(bad) => ended.push((node, Err(bad))),
                    },
                }
            }
        }
        ended.extend(update(adapter, at, entry, program, &due, options, on_event));
        ended.sort_by_key(|(node, _)| *node);
        let is_changed = |result: &Result<Good, Bad>| match result {
            Ok(Good::Updated(_)) => true,
            Err(Bad::Failed(failed)) => failed.left.state != DeviceState::Untouched,
            Ok(Good::Had) | Err(Bad::Left(_)) => false,
        };
        changed.extend(ended.iter().filter(|(_, result)| is_changed(result)).map(|(node, _)| *node));
        for (node, result) in &mut ended {
            let is_changed = changed.contains(node);
            let before = if is_changed { DeviceState::OtherChanged } else { options.known.state() };
            if let Err(Bad::Failed(Failed { left, .. })) = result {
                *left = left.after(before);
            }
        }
        let is_older = |bad: &Bad| matches!(bad, Bad::Left(DeviceFault::Older { .. }));
        let bad = ended.iter().filter(|(_, result)| result.as_ref().is_err_and(|bad| !is_older(bad)));
        failed.extend(bad.map(|(node, _)| *node));
        outcomes.extend(ended.into_iter().map(|(node, result)| Outcome {
            node: Some(node),
            entry: at,
            result,
        }));
    }
    outcomes
}

/// Compares the identity of a device with that in the plan; returns the part that is compared again just before
/// the device is written.
fn is_the_same(
    adapter: &mut dyn Adapter,
    entry: &Entry,
    device: &Device,
    options: &RunOptions,
) -> Result<Target, Bad> {
    let node = device.node;
    if options.many.cancelled.load(Ordering::Relaxed) {
        return Err(untouched(Error::Cancelled));
    }
    let mut session = Session::new(adapter, node, options.many.timing);
    session.cancel_by(options.many.cancelled.clone());
    if options.flash.alone {
        // Before the first request, as in `reach`: it would disturb another tool's running transfer.
        session.ensure_alone().map_err(untouched)?;
    }
    let now = session.find().and_then(|_| identity(&mut session)).map_err(untouched)?;
    let revision = entry.identity.is_some_and(|identity| identity.revision.is_some());
    let names = ["vendor-ID", "product code", "revision", "serial number"];
    // Bootloader and application need not report the same parts, and 0 is no report.
    let differs = |((what, was), is): ((&'static str, Option<u32>), Option<u32>)| {
        let counts = what != "revision" || revision;
        let is_told = |part: Option<u32>| part.is_some_and(|part| part != 0);
        let is_other = counts && is_told(was) && is_told(is) && was != is;
        is_other.then(|| DeviceFault::Exchanged { node, what, was: hex(was), is: hex(is) })
    };
    match names.into_iter().zip(device.identity).zip(now).find_map(differs) {
        Some(fault) => Err(Bad::Left(fault)),
        // What runs now has said it: the bootloader may report less than the application did in the plan.
        None => Ok(entry.identity.map_or_else(
            || Target { vendor_id: now[0].unwrap_or(0), product_code: now[1].unwrap_or(0) },
            |identity| Target { vendor_id: identity.vendor, product_code: identity.product },
        )),
    }
}

/// An error before the device was changed.
fn untouched(error: Error) -> Bad {
    let left = DeviceAfterUpdate { state: DeviceState::Untouched, answer: DeviceAnswer::NotAsked };
    Bad::Failed(Failed { error, left })
}

/// Writes a program to these devices.
fn update(
    adapter: &mut dyn Adapter,
    at: usize,
    entry: &Entry,
    program: &Payload,
    devices: &[(NodeId, Target)],
    options: &RunOptions,
    on_event: &(dyn Fn(NodeId, usize, Event) + Sync),
) -> Vec<(NodeId, Result<Good, Bad>)> {
    let flash = FlashOptions {
        // A renewal finds the number of the bootloader by itself.
        program: if entry.is_bootloader() { options.flash.program } else { entry.program },
        trial_run: entry.trial_run,
        verify: entry.verify || options.flash.verify,
        dialect: entry.dialect().or(options.flash.dialect),
        ..options.flash
    };
    let job = |(node, target): &(NodeId, Target)| {
        let job = Job::new(*node, program.clone(), flash.check_target(Some(*target)));
        Job { known: options.known, ..job }
    };
    let jobs: Vec<Job> = devices.iter().map(job).collect();
    let results = flash_many(adapter, &jobs, &options.many, &|number, event| {
        if let Some(job) = jobs.get(number) {
            on_event(job.node, at, event);
        }
    });
    let good = |result: Result<Report, Failed>| match result {
        // The device has found that it has this bootloader.
        Ok(report) if report.renewal.is_some_and(|renewal| renewal.unchanged) => Ok(Good::Had),
        Ok(report) => Ok(Good::Updated(report)),
        Err(failed) => Err(Bad::Failed(failed)),
    };
    devices.iter().map(|(node, _)| *node).zip(results.into_iter().map(good)).collect()
}
