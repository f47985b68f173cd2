//! The state of a station, and what its page shows of it.

use std::sync::{Arc, Mutex};

use coflash_core::device::Dialect;
use coflash_core::machine::{Entry, Plan};
use serde_json::{json, Value};

use super::message::Message;
use super::report::{self, Kind, Of, Report};
use super::row::{self, headline, Known, Row, RowState};
use super::setup::Service;
use super::sheet::contents;
use crate::shared::{lock, Shared};
use crate::state;

/// What is being done, and the devices of it.
#[derive(Clone, Debug, Default)]
pub(super) enum Stage {
    /// The bus was not searched yet.
    #[default]
    Waiting,
    Searching,
    /// A plan that nobody has confirmed yet.
    Planned {
        /// Its number: a page confirms the plan that it shows.
        number: u64,
        plan: Arc<Plan>,
    },
    Working(Vec<Row>),
    Ended(Vec<Row>),
}

#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) stage: Stage,
    /// The number of plans since the start.
    pub(super) plans: u64,
    /// Why the last search or update was not carried out.
    pub(super) message: Option<Message>,
    /// That of the machine that is being updated or was updated last.
    pub(super) device_number: String,
    /// Whether a device of this machine needs a password: the page has a field for it, and nothing keeps it.
    pub(super) asks_password: bool,
    /// What is known of devices from earlier updates.
    pub(super) known: Known,
    /// The report of the machine of the last update.
    sheet: Option<Report>,
    /// The names of the saved reports of the last update, with their endings.
    saved: Vec<String>,
    /// The number of reports that could not be saved.
    unsaved: usize,
    /// Why.
    why: Option<Message>,
}

pub(super) struct Station {
    pub(super) service: Service,
    state: Mutex<State>,
    /// The reports that are not saved yet; locked while they are written.
    unsaved: Mutex<Vec<Report>>,
    /// The names of the reports about what has begun.
    begun: Mutex<Vec<String>>,
}

impl Station {
    pub(super) fn new(service: Service) -> Self {
        // A lift is always locked. Others say so in an update.
        let is_locked = |(entry, _): (&Entry, _)| entry.dialect() == Some(Dialect::Lift);
        let asks_password = service.package.programs().any(is_locked);
        let state = State { asks_password, ..State::default() };
        Self { service, state: Mutex::new(state), unsaved: Mutex::default(), begun: Mutex::default() }
    }

    /// Changes the state. The caller has all pages notified.
    pub(super) fn change<R>(&self, change: impl FnOnce(&mut State) -> R) -> R {
        change(&mut lock(&self.state))
    }

    /// The plan with this number, if it is the one that can be confirmed.
    pub(super) fn plan(&self, wanted: u64) -> Option<Arc<Plan>> {
        match &lock(&self.state).stage {
            Stage::Planned { number, plan } if *number == wanted => Some(plan.clone()),
            _ => None,
        }
    }

    /// Saves a report of each device that is about to be written. Returns why that is not possible.
    pub(super) fn begin(&self, rows: &[Row], of: &Arc<Of>) -> Option<Message> {
        let folder = &self.service.folder;
        let mut begun = lock(&self.begun);
        for row in rows.iter().filter(|row| row.state == RowState::Waiting) {
            let report = Report::begun(row.clone(), of.clone());
            match folder.save(&report.name(), &contents(&report)) {
                Ok(name) => begun.push(name),
                Err(error) => {
                    begun.drain(..).for_each(|name| folder.remove(&name, Report::ENDINGS));
                    return Some(report::unsaved(&error, folder.path()));
                }
            }
        }
        None
    }

    /// Keeps reports, and saves them.
    pub(super) fn keep(&self, reports: Vec<Report>) {
        self.change(|state| {
            state.saved.clear();
            state.sheet = reports.iter().find(|report| report.kind == Kind::Machine).cloned();
        });
        lock(&self.unsaved).extend(reports);
        self.save();
    }

    /// Saves the reports that are not saved yet. Returns why some still are not.
    pub(super) fn save(&self) -> Option<Message> {
        let mut unsaved = lock(&self.unsaved);
        let mut saved = Vec::new();
        let mut why = None;
        unsaved.retain(|report| match self.service.folder.save(&report.name(), &contents(report)) {
            Ok(name) => {
                saved.push(name + if report.kind == Kind::Machine { ".html" } else { ".html, .csv" });
                false
            }
            Err(error) => {
                why = Some(report::unsaved(&error, self.service.folder.path()));
                true
            }
        });
        let left = unsaved.len();
        if left == 0 {
            // The outcomes take the place of what has begun.
            lock(&self.begun).drain(..).for_each(|name| self.service.folder.remove(&name, Report::ENDINGS));
        }
        self.change(|state| {
            state.saved.extend(saved);
            (state.unsaved, state.why) = (left, why.clone());
        });
        why
    }

    /// The reports that are not saved, one a line; none if all are.
    pub(super) fn unsaved_words(&self) -> Option<String> {
        let unsaved = lock(&self.unsaved);
        let lines: Vec<String> = unsaved.iter().map(Report::line).collect();
        let folder = self.service.folder.path().display();
        let all = || format!("these reports could not be saved in {folder}:\n{}", lines.join("\n"));
        (!lines.is_empty()).then(all)
    }

    /// A report that could not be saved, for the browser to save.
    pub(super) fn unsaved(&self, number: usize) -> Option<Report> {
        lock(&self.unsaved).get(number).cloned()
    }

    /// The report of the machine of the last update.
    pub(super) fn sheet(&self) -> Option<Report> {
        lock(&self.state).sheet.clone()
    }

    /// What the page shows.
    pub(super) fn view(&self, shown: &state::State) -> Value {
        use state::Connection;
        let mut own = lock(&self.state);
        let adapter = &shown.adapter;
        let (mut rows, mut number, mut others) = (Vec::new(), None, Vec::new());
        match &own.stage {
            Stage::Waiting | Stage::Searching => {}
            Stage::Planned { number: planned, plan } => {
                rows = row::rows(plan);
                (number, others) = (Some(*planned), row::others(plan));
            }
            Stage::Working(all) | Stage::Ended(all) => rows.clone_from(all),
        }
        let due = rows.iter().filter(|row| matches!(row.state, RowState::Due | RowState::Older)).count();
        if matches!(own.stage, Stage::Working(_)) {
            rows.iter_mut().for_each(|row| row.advance(&shown.updates));
        }
        own.known.recall(&mut rows);
        let is_busy = shown.task.is_some();
        let is_good = |row: &Row| !matches!(row.state, RowState::Failed);
        let ended = headline(&rows);
        let (station, hint) = match (&own.stage, adapter.state) {
            (Stage::Searching, _) if is_busy => ("searching", None),
            (Stage::Working(_), _) if is_busy => ("working", Some("hint-working")),
            (Stage::Ended(rows), _) if !rows.iter().all(is_good) => ("bad", Some(ended.1)),
            (Stage::Ended(_), _) if own.unsaved > 0 => ("good-unsaved", Some("hint-good-unsaved")),
            (Stage::Ended(_), _) => ("good", Some(ended.1)),
            // An update without a task was ended by an internal error.
            (Stage::Working(_), _) => ("bad", Some("hint-bad")),
            (_, Connection::Closed) => ("closed", Some("hint-closed")),
            (_, Connection::Opening) => ("opening", None),
            (_, Connection::Lost) => ("lost", None),
            (Stage::Waiting | Stage::Searching, Connection::Open) => ("ready", Some("hint-ready")),
            (Stage::Planned { .. }, Connection::Open) if due > 0 && rows.iter().all(is_good) => {
                ("planned", Some("hint-planned"))
            }
            (Stage::Planned { .. }, Connection::Open) if due > 0 => ("planned-bad", Some("hint-planned-bad")),
            (Stage::Planned { plan, .. }, Connection::Open) if plan.devices.is_empty() => {
                ("none", Some("hint-none"))
            }
            (Stage::Planned { plan, .. }, Connection::Open) if plan.is_of_other_machine() => {
                ("other-machine", Some("hint-other-machine"))
            }
            (Stage::Planned { .. }, Connection::Open) if rows.iter().all(is_good) => {
                ("complete", Some("hint-good"))
            }
            (Stage::Planned { .. }, Connection::Open) => ("planned-bad", Some("hint-incomplete")),
        };
        // The state of an update that has ended is said as it has ended.
        let says = if matches!(station, "good" | "bad") { ended.0 } else { station };
        json!({
            "station": station,
            "says": says,
            "hint": hint,
            "message": own.message(shown),
            "adapter": adapter.url,
            "open": adapter.state == Connection::Open,
            "busy": is_busy,
            "cancelling": shown.task.as_ref().is_some_and(|task| task.cancelling),
            "plan": number,
            "plans": own.plans,
            "device_number": own.device_number,
            "asks_password": own.asks_password,
            "rows": rows,
            "others": others,
            "saved": own.saved,
            "sheet": own.sheet.is_some(),
            "unsaved": own.unsaved,
            "why": own.why,
        })
    }
}

impl State {
    /// Why the page cannot go on as its user wants, if something is wrong.
    fn message(&self, shown: &state::State) -> Option<Message> {
        let adapter = &shown.adapter;
        let notice = shown.notice.as_ref().filter(|notice| !notice.ok);
        match (&adapter.words, &self.message, notice) {
            (Some(words), _, _) => Some(Message::new("adapter-lost").detail(words)),
            (None, Some(message), _) => Some(message.clone()),
            (None, None, Some(notice)) if adapter.state == state::Connection::Closed => {
                Some(Message::new("adapter-failed").detail(&notice.words))
            }
            (None, None, Some(notice)) => Some(Message::new("internal").detail(&notice.words)),
            (None, None, None) => None,
        }
    }
}

/// Changes the state, and notifies all pages.
pub(super) fn change<R>(shared: &Shared, station: &Station, change: impl FnOnce(&mut State) -> R) -> R {
    shared.change(|_| station.change(change))
}
