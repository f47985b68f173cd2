//! The update of a machine with a package: scan, plan and run are those of the library.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};

use canopen::NodeId;
use coboot_can::Link;
use coflash_core::device::lock::Lock;
use coflash_core::device::scan::ScanOptions;
use coflash_core::machine::{plan, run, Bad, DeviceFault, Good, Outcome, Package, PlanError, RunOptions};
use coflash_core::update::{DeviceState, Event, Known, ManyOptions};
use coflash_core::Error;

use super::config::Machine;
use super::controller::{Flashed, News};
use super::progress::{failure, not_now, waits, Shown};

/// What a machine gets.
pub(super) struct Order<'o> {
    pub(super) machine: &'o Machine,
    pub(super) package: &'o Package,
    /// What is known of its devices from an earlier agent.
    pub(super) known: Known,
}

/// Updates the devices of a bus that the package is for. An interrupted update goes on with another call:
/// its plan leaves out what the devices have, and what is known of them says that it is such a one.
///
/// # Errors
/// How it ended before any device was changed.
pub(super) fn update(
    link: Link,
    url: &str,
    Order { machine, package, known }: &Order<'_>,
    cancelled: &Arc<AtomicBool>,
    news: &Sender<News>,
) -> Result<Flashed, Flashed> {
    let shown = Shown::default();
    let Link::Bus(mut adapter) = shown.on(link) else {
        let what = "a gateway cannot search the bus for the devices of a package";
        let advice = "what to do: set bus in the agent's configuration to an adapter on the machine's bus";
        return Err(Flashed::Failed(vec![what.to_string(), advice.to_string()]));
    };
    // Before the scan, which ends the transfers of all nodes. The others are known after it.
    let mut locks = BTreeMap::new();
    let in_use = |error: Error| Flashed::NotNow(error.to_string());
    Lock::more(url, package.nodes(), &mut locks).map_err(in_use)?;
    let mut plan =
        plan(&mut *adapter, package, &ScanOptions::default().alone(true), cancelled).map_err(unplanned)?;
    if machine.allow_older {
        plan.allow_older(|_| true);
    }
    Lock::more(url, plan.nodes(), &mut locks).map_err(in_use)?;
    for line in plan.to_string().lines() {
        let _ = news.send(News::Phase(line.to_string()));
    }
    let all = plan.updates().max(1);
    let percents = Mutex::new(BTreeMap::new());
    let report = |node: NodeId, entry: usize, event: Event| {
        for item in shown.news(node, &event) {
            let of_all = match item {
                // A part of the machine keeps its program, and not the machine: the next plan finds out.
                News::Kept => continue,
                News::Failed(_) => item,
                News::Phase(words) => News::Phase(format!("node {node}: {words}")),
                News::Percent(percent) => {
                    let mut percents = percents.lock().unwrap_or_else(PoisonError::into_inner);
                    percents.insert((node, entry), usize::from(percent));
                    let percent = percents.values().sum::<usize>() / all;
                    News::Percent(u8::try_from(percent).unwrap_or(100))
                }
            };
            let _ = news.send(of_all);
        }
    };
    let many = ManyOptions::default().cancelled(cancelled.clone());
    let options = RunOptions::default().many(many).known(*known);
    Ok(flashed(package, *known, &run(&mut *adapter, package, &plan, &options, &report)))
}

/// The end of an update without a plan: no device was changed.
fn unplanned(error: PlanError) -> Flashed {
    let (what, number, advice) = match &error {
        PlanError::Bus(Error::Cancelled) => return Flashed::Interrupted,
        PlanError::Bus(bus) => match not_now(bus) {
            Some(why) => return Flashed::NotNow(why),
            None => (bus.to_string(), bus.number(), bus.advice().to_string()),
        },
        PlanError::Package(fault) => (error.to_string(), fault.number(), fault.advice().to_string()),
    };
    Flashed::Failed(vec![format!("{what} [{number:#010X}]"), format!("what to do: {advice}")])
}

/// The end of an update for the server: how many programs are in their devices, what is wrong with each other
/// device, and which devices have what.
fn flashed(package: &Package, known: Known, outcomes: &[Outcome]) -> Flashed {
    if outcomes.is_empty() {
        let what = "no device on the bus is one that the package is for, and nothing was changed";
        let advice =
            "what to do: check bus in the agent's configuration, and that the package is for this machine";
        return Flashed::Failed(vec![what.to_string(), advice.to_string()]);
    }
    let is_cancelled =
        |bad: &Bad| matches!(bad, Bad::Failed(failed) if matches!(failed.error, Error::Cancelled));
    if outcomes.iter().filter_map(|outcome| outcome.result.as_ref().err()).any(is_cancelled) {
        return Flashed::Interrupted;
    }
    if let Some(why) = all_wait(outcomes) {
        return Flashed::NotNow(why);
    }
    let good = outcomes.iter().filter(|outcome| outcome.result.is_ok()).count();
    let mut lines = vec![format!("{good} of {} programs are in their devices", outcomes.len())];
    let names: Vec<&str> = package.programs().map(|(entry, _)| entry.name.as_str()).collect();
    for outcome in outcomes {
        let (Err(bad), Some(name)) = (&outcome.result, names.get(outcome.entry)) else { continue };
        let whom = outcome.node.map_or_else(|| "machine".to_string(), |node| format!("node {node}"));
        let words = match bad {
            Bad::Failed(failed) => failure(failed).join("; "),
            Bad::Left(fault) => {
                format!("{fault} [{:#010X}]; what to do: {}", fault.number(), fault.advice())
            }
        };
        lines.push(format!("{whom}: {name}: {words}"));
    }
    for (at, name) in names.iter().enumerate() {
        let which = |of: fn(&Good) -> bool| {
            let all = outcomes.iter().filter(|outcome| outcome.entry == at);
            let all = all.filter(|outcome| outcome.result.as_ref().is_ok_and(of));
            let nodes: Vec<String> = all.filter_map(|outcome| Some(outcome.node?.to_string())).collect();
            nodes.join(", ")
        };
        let updated = which(|good| matches!(good, Good::Updated(_)));
        let had = which(|good| matches!(good, Good::Had));
        // Before the attempts of this action, or since one of them.
        let has_begun = known.state() == DeviceState::Begun;
        let before = if has_begun { "had it before this attempt: node" } else { "had it before: node" };
        for (what, nodes) in [("updated: node", updated), (before, had)] {
            if !nodes.is_empty() {
                lines.push(format!("{name}: {what} {nodes}"));
            }
        }
    }
    match good == outcomes.len() {
        true => Flashed::Done(lines),
        false => Flashed::Failed(lines),
    }
}

/// Why nothing was changed, if the bus or the devices are in use or absent, and nothing else is wrong.
fn all_wait(outcomes: &[Outcome]) -> Option<String> {
    let mut why = None;
    for outcome in outcomes {
        match &outcome.result {
            Ok(Good::Had) | Err(Bad::Left(DeviceFault::EarlierFailed { .. })) => {}
            Err(Bad::Failed(failed)) => {
                let words = waits(failed)?;
                why.get_or_insert(words);
            }
            Ok(Good::Updated(_)) | Err(Bad::Left(_)) => return None,
        }
    }
    why
}
