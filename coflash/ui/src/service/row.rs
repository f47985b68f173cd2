//! The devices of a plan or an update, as the page and the reports have them.

use std::collections::{BTreeMap, BTreeSet};

use canopen::NodeId;
use coflash_core::machine::{Bad, DeviceFault, Foreign, Good, Outcome, Plan, Stranger, Todo};
use serde::Serialize;

use super::message::Message;
use super::trouble;
use crate::state::{self, may_be_of};

/// A device, or one that is missing.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Row {
    pub(super) node: Option<u8>,
    /// 1008h.
    pub(super) name: Option<String>,
    /// 1018h/1 to 4.
    pub(super) identity: [Option<u32>; 4],
    pub(super) state: RowState,
    pub(super) steps: Vec<Step>,
    /// The report of an update that did not end, from which it has its program.
    #[serde(skip)]
    pub(super) interrupted: Option<String>,
    /// The program of a device that is missing.
    #[serde(skip)]
    pub(super) missing: Option<String>,
    /// What went wrong.
    pub(super) trouble: Option<Message>,
    /// The key of what is in the device after that.
    pub(super) left: Option<&'static str>,
    /// The key of [`Self::outcome`], for the page.
    pub(super) says: &'static str,
    /// In percent, while it is being written.
    pub(super) percent: Option<usize>,
}

/// A device that nothing of the package is for.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Other {
    pub(super) node: u8,
    /// 1008h.
    pub(super) name: Option<String>,
    /// 1018h/1 to 4; none of a device that did not say what it is.
    pub(super) identity: Option<[Option<u32>; 4]>,
    /// Why it did not.
    pub(super) trouble: Option<Message>,
}

/// A program of a device.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Step {
    #[serde(skip)]
    pub(super) entry: usize,
    pub(super) program: String,
    pub(super) from: Option<String>,
    pub(super) to: String,
    pub(super) state: RowState,
    /// Whether it is written because its CRC is that of each of its versions.
    pub(super) every_version_has_this_crc: bool,
    /// What the device has reported of it after the update: its CRC (1F56h).
    #[serde(skip)]
    pub(super) crc: Option<u32>,
    /// Whether it has passed its trial run.
    #[serde(skip)]
    pub(super) tried: bool,
    /// What went wrong with it, and the key of what is in the device after that. The row has the first of its programs.
    #[serde(skip)]
    pub(super) trouble: Option<Message>,
    #[serde(skip)]
    pub(super) left: Option<&'static str>,
}

/// The state of a device or of one of its programs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(into = "&'static str")]
pub(super) enum RowState {
    /// It has its program already.
    #[default]
    Has,
    /// It would get its program.
    Due,
    /// It has a newer program, and gets the older one if the user wants it.
    Older,
    /// It would get its program, and the user has left it out.
    LeftOut,
    Waiting,
    Working,
    Updated,
    Failed,
}

/// The key in the table.
impl From<RowState> for &'static str {
    fn from(state: RowState) -> Self {
        match state {
            RowState::Has => "state-has",
            RowState::Due => "state-due",
            RowState::Older => "state-older",
            RowState::LeftOut => "state-left-out",
            RowState::Waiting => "state-waiting",
            RowState::Working => "state-working",
            RowState::Updated => "state-updated",
            RowState::Failed => "state-failed",
        }
    }
}

/// The devices of a plan, and what is missing.
pub(super) fn rows(plan: &Plan) -> Vec<Row> {
    let devices = plan.devices.iter().map(|device| {
        let steps = device.steps.iter().map(|step| Step {
            entry: step.entry,
            program: step.program.clone(),
            from: step.from.clone(),
            to: step.to.clone(),
            state: match step.todo {
                Todo::Has => RowState::Has,
                Todo::Update => RowState::Due,
                Todo::Older => RowState::Older,
                Todo::Leave(_) => RowState::Failed,
            },
            every_version_has_this_crc: step.every_version_has_this_crc,
            trouble: match &step.todo {
                // Of another machine it is said once.
                Todo::Leave(fault) if !plan.is_of_other_machine() => Some(trouble::of_device(fault)),
                _ => None,
            },
            ..Step::default()
        });
        let steps: Vec<Step> = steps.collect();
        let mut row = Row {
            node: Some(device.node.get()),
            name: device.name.clone(),
            identity: device.identity,
            trouble: steps.iter().find_map(|step| step.trouble.clone()),
            steps,
            ..Row::default()
        };
        row.sum();
        row
    });
    let missing = plan.missing.iter().map(|missing| Row {
        node: missing.node.map(NodeId::get),
        state: RowState::Failed,
        missing: Some(missing.program.clone()),
        trouble: Some(trouble::of_missing(missing)),
        ..Row::default()
    });
    devices.chain(missing).collect()
}

/// The devices of a plan that are left alone.
pub(super) fn others(plan: &Plan) -> Vec<Other> {
    let other = |Foreign { node, what }: &Foreign| {
        let (name, identity, trouble) = match what {
            Stranger::Device { name, identity } => (name.clone(), Some(*identity), None),
            Stranger::Silent => (None, None, Some(Message::new("other-silent"))),
            Stranger::Mute { but } => (None, None, Some(Message::new("other-mute").detail(but))),
        };
        Other { node: node.get(), name, identity, trouble }
    };
    plan.foreign.iter().map(other).collect()
}

impl Step {
    /// Whether the device was written, or has begun with that: its identity was compared right before.
    pub(super) fn is_begun(&self) -> bool {
        let is_changed = self.left.is_some_and(|left| !matches!(left, "left-untouched" | "left-other"));
        self.state == RowState::Updated || is_changed
    }
}

impl Row {
    /// The state of the device, from those of its programs.
    fn sum(&mut self) {
        let all = [RowState::Due, RowState::Older, RowState::Failed, RowState::Updated, RowState::Has];
        let first = all.into_iter().find(|state| self.steps.iter().any(|step| step.state == *state));
        self.state = first.unwrap_or(self.state);
    }

    /// The key of what became of it, or will: of a device whose update has failed, what it has now.
    pub(super) fn outcome(&self) -> &'static str {
        match (self.state, self.left) {
            (RowState::Failed, Some("left-none")) => "state-empty",
            (RowState::Failed, Some("left-new")) => "state-new",
            (RowState::Failed, Some("left-unknown")) => "state-unknown",
            // One that answers in a wrong way is not missing.
            (RowState::Failed, None)
                if self.missing.is_some()
                    && self.trouble.as_ref().is_none_or(|why| why.key != "trouble-mute") =>
            {
                "state-missing"
            }
            (RowState::Failed, None) => "state-left-alone",
            (state, _) => state.into(),
        }
    }

    /// Takes a device into the update, or leaves it out. Beside a program that is due, an older one
    /// is left out: the user has not chosen it.
    pub(super) fn choose(&mut self, is_chosen: bool) {
        let wanted = self.state;
        let due = self.steps.iter_mut().map(|step| &mut step.state).chain([&mut self.state]);
        for state in due.filter(|state| matches!(state, RowState::Due | RowState::Older)) {
            *state = if is_chosen && *state == wanted { RowState::Waiting } else { RowState::LeftOut };
        }
    }

    /// Shows how far its update is.
    pub(super) fn advance(&mut self, updates: &[state::Update]) {
        let update = updates.iter().find(|update| Some(update.node) == self.node);
        let Some(update) = update.filter(|_| self.state == RowState::Waiting) else { return };
        if update.phase != state::Phase::Waiting {
            self.state = RowState::Working;
            self.percent = (update.done * 100).checked_div(update.total);
        }
    }

    /// What went wrong, each with its program and the key of what is in the device after that; the first one with
    /// what is known of the device.
    pub(super) fn troubles(&self) -> Vec<(&str, &Message, Option<&'static str>)> {
        let steps = self.steps.iter();
        let mut all: Vec<(&str, &Message, Option<&'static str>)> = steps
            .filter_map(|step| Some((step.program.as_str(), step.trouble.as_ref()?, step.left)))
            .collect();
        match (all.first_mut(), &self.trouble) {
            (Some(first), _) => first.2 = self.left,
            (None, trouble) => all.extend(trouble.iter().map(|trouble| ("", trouble, self.left))),
        }
        all
    }

    /// Whether an outcome belongs to this row.
    fn is_of(&self, outcome: &Outcome) -> bool {
        self.node.is_some()
            && self.node == outcome.node.map(NodeId::get)
            && self.steps.iter().any(|step| step.entry == outcome.entry)
    }
}

/// Notes what became of the devices.
pub(super) fn note(rows: &mut [Row], outcomes: &[Outcome]) {
    for outcome in outcomes {
        // What is missing has no step, and is known from the plan.
        let Some(row) = rows.iter_mut().find(|row| row.is_of(outcome)) else { continue };
        let is_new = row.steps.iter().any(|step| step.state == RowState::Updated);
        let Some(step) = row.steps.iter_mut().find(|step| step.entry == outcome.entry) else { continue };
        step.state = match &outcome.result {
            Ok(Good::Had) => RowState::Has,
            Ok(Good::Updated(report)) => {
                step.crc = report.device_crc.filter(|_| report.renewal.is_none());
                step.tried = report.tried;
                RowState::Updated
            }
            Err(Bad::Left(DeviceFault::Older { .. })) => RowState::LeftOut,
            Err(bad) => {
                let (message, left) = trouble::of_outcome(bad);
                // The first reason counts: the programs after it were not begun.
                if row.trouble.is_none() {
                    // "Its old program" would be that of the whole device.
                    let of_all =
                        left.map(|left| if is_new && left == "left-old" { "left-other" } else { left });
                    (row.trouble, row.left) = (Some(message.clone()), of_all);
                }
                (step.trouble, step.left) = (Some(message), left);
                RowState::Failed
            }
        };
        row.sum();
    }
}

/// The keys of what became of all devices of an update, and of what to do next.
pub(super) fn headline(rows: &[Row]) -> (&'static str, &'static str) {
    // A device with a program that failed may have got another one.
    let is_updated = || rows.iter().flat_map(|row| &row.steps).any(|step| step.state == RowState::Updated);
    let has_failed = rows.iter().any(|row| row.state == RowState::Failed);
    let is_stopped = |row: &Row| row.trouble.as_ref().is_none_or(|why| why.key == "trouble-cancelled");
    match () {
        () if rows.iter().any(|row| row.outcome() == "state-empty") => ("bad-empty", "hint-bad-empty"),
        () if has_failed && rows.iter().all(is_stopped) => ("stopped", "hint-stopped"),
        () if has_failed && !is_updated() => ("bad-none", "hint-bad"),
        () if has_failed => ("bad", "hint-bad"),
        () if rows.iter().flat_map(|row| &row.steps).any(|step| step.state == RowState::LeftOut) => {
            ("good-part", "hint-good-part")
        }
        () => ("good", "hint-good"),
    }
}

/// What is known of devices of a machine whose last update has failed.
#[derive(Clone, Debug, Default)]
pub(super) struct Known {
    /// By node-ID: 1018h/4, and the key of what the device has.
    devices: BTreeMap<u8, (Option<u32>, &'static str)>,
    /// The serial numbers of the machine.
    machine: BTreeSet<u32>,
}

impl Known {
    /// Enters it into the devices that were not asked since then, remembers what is known of the others, and has each
    /// row say so.
    pub(super) fn recall(&mut self, rows: &mut [Row]) {
        let serials: BTreeSet<u32> = rows.iter().filter_map(|row| row.identity[3]).collect();
        // Of another machine nothing is known.
        let are_known = !serials.is_empty() && !self.machine.is_empty();
        if are_known && serials.is_disjoint(&self.machine) {
            *self = Self::default();
        }
        for row in rows {
            let (node, serial) = (row.node.unwrap_or(0), row.identity[3]);
            // What a device says that has a program is right.
            let has_program = row.steps.iter().any(|step| step.from.is_some());
            match (row.state, row.left) {
                (RowState::Failed, None | Some("left-untouched")) => {
                    let known = self.devices.get(&node).filter(|(known, _)| may_be_of(*known, serial));
                    row.left = known.map(|(_, left)| *left).or(row.left);
                }
                (RowState::Failed, Some(left)) if left != "left-other" => {
                    self.devices.insert(node, (serial, left));
                    self.machine.extend(&serials);
                }
                (RowState::Due, _) if !has_program => {}
                // A program of it was written.
                (
                    RowState::Failed | RowState::Updated | RowState::Has | RowState::Due | RowState::Older,
                    _,
                ) => {
                    self.devices.remove(&node);
                }
                _ => {}
            }
            row.says = row.outcome();
        }
    }
}
