//! What one device does next: a state machine that gets answers and the time, and gives steps. It
//! does no I/O, and it never blocks.

use std::collections::VecDeque;
use std::time::Duration;

use serde::Serialize;
use serde_json::Value;

use coflash_core::update::FailedUpdate;

use super::backoff::Jitter;
use super::config::Attempt;
use super::ddi::{self, Artifact, Base, Cancel, Deployment, Execution, Finished, Handling, LINES_MOST};
use super::record::{Finish, Record, RunningAction};

/// What is to be done next. Each step but `Wait` has exactly one answer.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Step {
    /// Nothing before this time, unless news come.
    Wait(Duration),
    /// A request to the server; the answer goes to [`Controller::answered`].
    Ask(Request),
    /// The next piece of a file; the answer goes to [`Controller::fetched`].
    Fetch(Wanted),
    /// The record is to be written; the answer goes to [`Controller::saved`].
    Save(Record),
    /// The device is to be asked for its attributes, while other steps go on; the answer goes to
    /// [`Controller::device_answered`].
    AskDevice,
    /// The device is to be flashed, while other steps go on; the answer goes to
    /// [`Controller::flashed`].
    Flash(Flash),
}

/// A request to the server.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Request {
    /// GET of a link of the server; the empty one is the device's root resource.
    Get(String),
    /// POST to a path below the root resource.
    Post(String, Value),
    /// PUT to a path below the root resource.
    Put(String, Value),
}

/// The answer to a request: its status, and its body if that is 200.
#[derive(Clone, Debug)]
pub(super) struct Reply {
    pub(super) status: u16,
    /// The header `Retry-After`.
    pub(super) retry_after: Option<Duration>,
    pub(super) body: Vec<u8>,
}

/// A file to be fetched.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Wanted {
    pub(super) name: String,
    pub(super) link: String,
    pub(super) size: u64,
    pub(super) sha256: String,
}

/// What became of one attempt to fetch a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Piece {
    /// The whole file is there; size and SHA-256 are right.
    Whole,
    /// The transfer has paused after this many bytes of the file; the server can go on there.
    More { at: u64 },
    /// The transfer broke off after this many bytes of the file.
    Cut { at: u64, why: String, retry_after: Option<Duration> },
    /// The server sends something else than it has announced.
    Wrong(String),
}

/// An order to flash the device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Flash {
    pub(super) wanted: Wanted,
    /// Whether an agent before this one has seen that the device keeps the program: if the device
    /// says so too, it needs nothing more.
    pub(super) kept: bool,
    /// Whether an agent before this one has begun with it, and may have changed the device.
    pub(super) begun: bool,
}

/// What became of an order to flash; the texts are for the server.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Flashed {
    /// The device runs the program.
    Done(Vec<String>),
    /// It does not, and another attempt is the server's business.
    Failed(Vec<String>),
    /// The bus or the device is in use or absent; nothing was changed.
    NotNow(String),
    /// The agent is being ended.
    Interrupted,
}

/// News of an update.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum News {
    /// What is being done now.
    Phase(String),
    /// The percentage of the transfer.
    Percent(u8),
    /// The device keeps the program from now on, whatever happens.
    Kept,
    /// The update of a device has failed: what it has shown.
    Failed(FailedUpdate),
}

/// A message for the people who run the agent.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Message {
    /// The device.
    pub controller: String,
    /// What it is about.
    #[serde(rename = "event")]
    pub kind: Kind,
    /// The words.
    pub text: String,
    /// What a device has shown whose update has failed; with [`Kind::Report`] alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub update: Option<FailedUpdate>,
}

/// What a message is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Kind {
    /// A deployment was taken, or is held.
    Deployment,
    /// Its update goes on.
    Progress,
    /// The device was updated.
    Updated,
    /// The device could not be updated.
    Failed,
    /// The server has cancelled a deployment.
    Cancelled,
    /// What a device has shown whose update has failed, for a report.
    Report,
    /// Something went wrong that is tried again.
    Trouble,
    /// Something else.
    Note,
}

/// The rules for one device.
#[derive(Clone, Debug)]
pub(super) struct Rules {
    pub(super) part: Option<String>,
    pub(super) artifact: Option<String>,
    pub(super) attempt: Attempt,
    pub(super) confirm: bool,
    /// The largest file that is fetched, in bytes.
    pub(super) size_most: u64,
    /// The shortest and longest pause between two polls.
    pub(super) poll: (Duration, Duration),
    /// The first and longest pause after a failure.
    pub(super) backoff: (Duration, Duration),
    /// The pause between two messages of progress.
    pub(super) progress: Duration,
}

/// The pause between polls if the server names none: hawkBit's default.
const SLEEP: Duration = Duration::from_secs(300);
/// How many polls may come early in a pause: after a download, and after the update.
const EARLY_MOST: u32 = 2;
/// The longest pause that a server can ask for with `Retry-After`.
const RETRY_MOST: Duration = Duration::from_secs(3600);
/// How many attempts in a row may fetch nothing.
const FETCHES_MOST: u32 = 12;
/// How many times a file may be another than announced.
const WRONG_MOST: u32 = 2;
/// How many messages of progress an action gets: hawkBit keeps 1000.
const TOLD_MOST: u32 = 100;
/// How many lines wait for a message: the longest plan of a machine has a line for each program of 127 devices.
const PHASES_MOST: usize = 1000;
/// What a failure adds if an agent before this one, or an attempt that was interrupted, has begun with the device.
const BEGUN_EARLIER: &str =
    "an earlier attempt of this action has begun with the device, and may have changed it";
/// The progress that is worth a message, in percent.
const WORTH: u8 = 10;

/// A deployment that was taken.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Task {
    action: String,
    wanted: Wanted,
    download: Handling,
    update: Handling,
    closed: bool,
}

impl Task {
    /// Whether the device may be changed now.
    fn may_begin(&self, attempt: Attempt) -> bool {
        let wanted = match self.update {
            Handling::Skip => false,
            Handling::Attempt => attempt == Attempt::Update,
            Handling::Forced => true,
        };
        wanted && !self.closed
    }
}

/// The state of the deployment.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Work {
    None,
    /// The file is being fetched.
    Fetching {
        task: Task,
        at: Duration,
        /// The most bytes of the file that were there: an attempt that begins anew has made no
        /// progress before.
        highest: u64,
        /// The attempts since then.
        failures: u32,
        wrong: u32,
    },
    /// The file is there. The deployment is read again before the device is changed.
    Ready {
        task: Task,
        at: Duration,
        /// Whether the deployment was read since the file is there.
        fresh: bool,
        /// Whether the server has the report why the deployment is held.
        reported: bool,
        /// How many times the bus or the device was in use or absent.
        tries: u32,
    },
    /// The device is being changed.
    Flashing {
        task: Task,
        started: bool,
        /// Whether this agent was the first to begin.
        first: bool,
        tries: u32,
        progress: Progress,
    },
    /// The end is in the record, and is to be reported to the server.
    Ended {
        action: String,
    },
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Progress {
    /// The phases since the last message.
    phases: Vec<String>,
    percent: u8,
    reported: u8,
    /// Whether there is something worth a message.
    news: bool,
    /// Not before this time.
    at: Duration,
    count: u32,
}

/// A request whose answer is awaited, or one still to be made.
#[derive(Clone, Debug, PartialEq)]
enum Ask {
    Base,
    Cancel(String),
    CancelReply {
        cancel: Cancel,
        refused: Option<String>,
    },
    Deployment(String),
    Config(Vec<(String, String)>),
    Confirm(String),
    /// A message on the way; it may get lost.
    Tell {
        action: String,
        body: Value,
    },
    Closed(String),
}

/// Whether the device is to be asked, or was asked, for its data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum DeviceQuery {
    No,
    Wanted,
    Asked,
}

/// The state machine of one device.
#[derive(Debug)]
pub(super) struct Controller {
    name: String,
    rules: Rules,
    jitter: Jitter,
    record: Record,
    unsaved: bool,
    work: Work,
    query: DeviceQuery,
    todo: VecDeque<Ask>,
    asked: Option<Ask>,
    /// No request before this time.
    hold: Duration,
    poll_at: Duration,
    /// How many polls came early since the last one in its time, and whether the next one does.
    early: u32,
    is_early: bool,
    /// The last pause of the server, if it was none: it is said once.
    wrong_sleep: Option<String>,
    failures: u32,
    /// Whether the server has answered a poll.
    polled: bool,
    said: Vec<Message>,
}

impl Controller {
    pub(super) fn new(name: &str, rules: Rules, record: Record, seed: u64) -> Self {
        let mut controller = Self {
            name: name.to_string(),
            rules,
            jitter: Jitter::new(seed),
            record,
            unsaved: false,
            work: Work::None,
            query: DeviceQuery::No,
            todo: VecDeque::new(),
            asked: None,
            hold: Duration::ZERO,
            poll_at: Duration::ZERO,
            early: 0,
            is_early: false,
            wrong_sleep: None,
            failures: 0,
            polled: false,
            said: Vec::new(),
        };
        if let Some(begun) = controller.record.begun.clone() {
            controller.say(Kind::Note, format!("action {} was interrupted: it goes on", begun.action));
        }
        if let Some(finish) = controller.record.ended.iter().find(|finish| !finish.reported) {
            controller.work = Work::Ended { action: finish.action.clone() };
        }
        controller
    }

    /// The messages since the last call.
    pub(super) fn said(&mut self) -> Vec<Message> {
        std::mem::take(&mut self.said)
    }

    /// Whether there is nothing to do before the next poll.
    pub(super) fn is_settled(&self, now: Duration) -> bool {
        let held = match &self.work {
            Work::None => true,
            Work::Fetching { task, .. } => task.download == Handling::Skip,
            Work::Ready { task, fresh, .. } => *fresh && !self.may_begin(task),
            _ => false,
        };
        self.polled && held && self.todo.is_empty() && self.query == DeviceQuery::No && self.poll_at > now
    }

    /// The number of times in a row that the server did not answer as it should, or that the bus or
    /// the device was in use or absent.
    pub(super) fn failures(&self) -> u32 {
        match &self.work {
            Work::Ready { tries, .. } => self.failures.max(*tries),
            _ => self.failures,
        }
    }

    /// Whether what was fetched is still needed.
    pub(super) fn needs_file(&self) -> bool {
        matches!(self.work, Work::Fetching { .. } | Work::Ready { .. } | Work::Flashing { .. })
    }

    /// Whether the device is being changed.
    pub(super) fn is_flashing(&self) -> bool {
        matches!(self.work, Work::Flashing { started: true, .. })
    }

    /// What is to be done next.
    pub(super) fn next(&mut self, now: Duration) -> Step {
        if self.unsaved && now >= self.hold {
            return Step::Save(self.record.clone());
        }
        if self.query == DeviceQuery::Wanted && !matches!(self.work, Work::Flashing { .. }) {
            self.query = DeviceQuery::Asked;
            return Step::AskDevice;
        }
        if !self.unsaved {
            if let Work::Flashing { task, started: started @ false, first, .. } = &mut self.work {
                *started = true;
                let kept = self.record.begun.as_ref().is_some_and(|begun| begun.kept);
                return Step::Flash(Flash { wanted: task.wanted.clone(), kept, begun: !*first });
            }
        }
        if now < self.hold {
            return Step::Wait(self.hold);
        }
        if let Some(ask) = self.todo.pop_front() {
            return self.ask(ask);
        }
        let mut until = self.poll_at;
        match &mut self.work {
            Work::Ended { action } if !self.unsaved => {
                let action = action.clone();
                return self.ask(Ask::Closed(action));
            }
            Work::Flashing { task, progress, .. } if progress.news => {
                if now >= progress.at {
                    let rest = progress.phases.split_off(progress.phases.len().min(LINES_MOST));
                    progress.news = !rest.is_empty();
                    progress.reported = progress.percent;
                    progress.at = now + self.rules.progress;
                    progress.count += 1;
                    let percent = (progress.percent > 0).then_some(progress.percent);
                    let (action, phases) =
                        (task.action.clone(), std::mem::replace(&mut progress.phases, rest));
                    let body =
                        ddi::feedback(&action, Execution::Proceeding, Finished::None, percent, &phases);
                    return self.ask(Ask::Tell { action, body });
                }
                until = until.min(progress.at);
            }
            _ => {}
        }
        if now >= self.poll_at {
            return self.ask(Ask::Base);
        }
        match &self.work {
            Work::Fetching { task, at, .. } if task.download != Handling::Skip => {
                if now >= *at {
                    return Step::Fetch(task.wanted.clone());
                }
                until = until.min(*at);
            }
            Work::Ready { task, at, fresh: true, .. } if self.may_begin(task) => {
                if now >= *at {
                    self.begin();
                    return self.next(now);
                }
                until = until.min(*at);
            }
            _ => {}
        }
        Step::Wait(until)
    }

    fn ask(&mut self, ask: Ask) -> Step {
        let feedback = |of: &str, action: &str| format!("{of}/{action}/feedback");
        let request = match &ask {
            Ask::Base => Request::Get(String::new()),
            Ask::Cancel(link) | Ask::Deployment(link) => Request::Get(link.clone()),
            Ask::CancelReply { cancel, refused } => {
                let (execution, finished) = match refused {
                    Some(_) => (Execution::Rejected, Finished::None),
                    None => (Execution::Closed, Finished::Success),
                };
                let why = refused.clone().unwrap_or_else(|| "cancelled before the device was changed".into());
                let body = ddi::feedback(&cancel.id, execution, finished, None, &[why]);
                Request::Post(feedback("cancelAction", &cancel.id), body)
            }
            Ask::Config(attributes) => Request::Put("configData".into(), ddi::config_data(attributes)),
            Ask::Confirm(action) => {
                let details = ["confirmed by the agent's configuration"];
                let body = serde_json::json!({ "confirmation": "confirmed", "details": details });
                Request::Post(feedback("confirmationBase", action), body)
            }
            Ask::Tell { action, body } => Request::Post(feedback("deploymentBase", action), body.clone()),
            Ask::Closed(action) => {
                let finish = self.record.finish_of(action);
                let ok = finish.is_some_and(|finish| finish.ok);
                let finished = if ok { Finished::Success } else { Finished::Failure };
                let details = finish.map(|finish| finish.details.clone()).unwrap_or_default();
                let body = ddi::feedback(action, Execution::Closed, finished, None, &details);
                Request::Post(feedback("deploymentBase", action), body)
            }
        };
        self.asked = Some(ask);
        Step::Ask(request)
    }

    /// The answer to the last request; an error is one of the network.
    pub(super) fn answered(&mut self, now: Duration, reply: Result<Reply, String>) {
        let Some(ask) = self.asked.take() else { return };
        let reply = match reply {
            Ok(reply) => reply,
            Err(why) => return self.trouble(now, why, None),
        };
        match reply.status {
            200..=299 => {
                if let Err(why) = self.understood(now, &ask, &reply.body) {
                    self.trouble(now, why, None);
                } else if self.todo.is_empty() {
                    self.failures = 0;
                }
            }
            401 | 403 if !matches!(ask, Ask::Tell { .. } | Ask::CancelReply { .. } | Ask::Closed(_)) => {
                let advice = "check the token, and that the server accepts this kind of token";
                self.trouble(now, format!("the server refuses the token ({}): {advice}", reply.status), None);
            }
            401 | 408 | 429 | 500.. => {
                let why = format!("the server answers with status {}", reply.status);
                self.trouble(now, why, reply.retry_after);
            }
            status => self.refused(now, ask, status),
        }
    }

    /// A refusal that another attempt would not change.
    fn refused(&mut self, now: Duration, ask: Ask, status: u16) {
        match ask {
            Ask::Base | Ask::Config(_) => {
                let why =
                    format!("the server answers with status {status}: check url, tenant and controller-id");
                self.trouble(now, why, None);
            }
            // The action is no longer the server's wish; the next poll shows it.
            Ask::Cancel(_) | Ask::Deployment(_) | Ask::Confirm(_) | Ask::Tell { .. } => {}
            Ask::CancelReply { cancel, .. } => {
                self.say(
                    Kind::Note,
                    format!("action {}: the server has dropped the cancellation", cancel.stop),
                );
            }
            Ask::Closed(action) => {
                self.say(
                    Kind::Note,
                    format!("action {action}: the server no longer wants the result (status {status})"),
                );
                self.reported(now, &action);
            }
        }
    }

    /// A good answer.
    fn understood(&mut self, now: Duration, ask: &Ask, body: &[u8]) -> Result<(), String> {
        match ask {
            Ask::Base => self.base(now, Base::parse(body)?),
            Ask::Cancel(_) => self.cancel(Cancel::parse(body)?),
            Ask::Deployment(_) => self.deployment(now, Deployment::parse(body)?),
            Ask::CancelReply { cancel, refused: None } => {
                self.say(Kind::Cancelled, format!("action {} was cancelled", cancel.stop));
            }
            Ask::CancelReply { cancel, refused: Some(why) } => {
                self.say(Kind::Note, format!("action {} was not cancelled: {why}", cancel.stop));
            }
            Ask::Closed(action) => self.reported(now, action),
            Ask::Config(_) | Ask::Confirm(_) | Ask::Tell { .. } => {}
        }
        Ok(())
    }

    fn base(&mut self, now: Duration, base: Base) {
        self.polled = true;
        if !std::mem::take(&mut self.is_early) {
            self.early = 0;
        }
        let sleep = self.sleep(base.sleep);
        self.poll_at = now + self.jitter.longer(sleep);
        let nothing = base.deployment.is_none() && base.cancel.is_none();
        if let Some(link) = base.cancel {
            self.todo.push_back(Ask::Cancel(link));
        } else if let Some(link) = base.deployment {
            if !matches!(self.work, Work::Flashing { .. }) {
                self.todo.push_back(Ask::Deployment(link));
            }
        }
        if let Some(action) = base.confirmation.as_deref().filter(|_| self.rules.confirm).and_then(last_part)
        {
            self.todo.push_back(Ask::Confirm(action));
        }
        if base.config && self.query == DeviceQuery::No {
            self.query = DeviceQuery::Wanted;
        }
        if nothing && matches!(self.work, Work::Fetching { .. } | Work::Ready { .. }) {
            self.say(Kind::Cancelled, "the server has withdrawn the deployment".to_string());
            self.work = Work::None;
        }
        if nothing && self.work == Work::None {
            if let Some(begun) = self.record.begun.take() {
                let what =
                    format!("action {} was interrupted, and the server wants it no more", begun.action);
                self.say(Kind::Trouble, format!("{what}: the device may be without a program"));
                self.unsaved = true;
            }
        }
    }

    /// The pause until the next poll. A value that is no pause gets the default, and is said once.
    fn sleep(&mut self, asked: Option<Result<Duration, String>>) -> Duration {
        let (least, most) = self.rules.poll;
        let wrong = asked.as_ref().and_then(|asked| asked.as_ref().err().cloned());
        let sleep = asked.and_then(Result::ok).unwrap_or(SLEEP).clamp(least, most);
        if let Some(value) = wrong.as_ref().filter(|_| wrong != self.wrong_sleep) {
            self.say(
                Kind::Note,
                format!(
                    "the server asks for the pause {value}, which is neither HH:MM:SS nor an ISO 8601 duration: it is \
                     polled every {} s. Set the polling time of the server",
                    sleep.as_secs()
                ),
            );
        }
        self.wrong_sleep = wrong;
        sleep
    }

    fn cancel(&mut self, cancel: Cancel) {
        let flashing = matches!(&self.work, Work::Flashing { task, .. } if task.action == cancel.stop);
        let refused = if let Some(finish) = self.record.finish_of(&cancel.stop) {
            let how = if finish.ok { "the device was updated" } else { "the update has failed" };
            Some(format!("the action has already ended: {how}"))
        } else if flashing || self.record.has_begun(&cancel.stop) {
            Some("the device is being flashed: with half a program it could not work".to_string())
        } else {
            if matches!(&self.work, Work::Fetching { task, .. } | Work::Ready { task, .. } if task.action == cancel.stop)
            {
                self.work = Work::None;
            }
            None
        };
        self.todo.push_back(Ask::CancelReply { cancel, refused });
    }

    fn deployment(&mut self, now: Duration, deployment: Deployment) {
        let action = deployment.action.clone();
        if self.record.finish_of(&action).is_some() {
            self.say(
                Kind::Note,
                format!("action {action} was carried out before: the server gets its result again"),
            );
            self.work = Work::Ended { action };
            return;
        }
        let wanted = match self.choose(&deployment) {
            Ok(wanted) => wanted,
            Err(why) => return self.end(&action, false, vec![why]),
        };
        let Deployment { download, update, closed, .. } = deployment;
        let task = Task { action, wanted, download, update, closed };
        let may_begin = self.may_begin(&task);
        match &mut self.work {
            Work::Flashing { .. } => {}
            Work::Fetching { task: known, .. } if same(known, &task) => *known = task,
            Work::Ready { task: known, fresh, reported, .. } if same(known, &task) => {
                *known = task.clone();
                *fresh = true;
                if may_begin || std::mem::replace(reported, true) {
                    return;
                }
                let why = if task.closed {
                    "the maintenance window is closed"
                } else if task.update == Handling::Skip {
                    "the server wants the download alone"
                } else {
                    "the server does not force it"
                };
                self.say(Kind::Deployment, format!("action {}: held, because {why}", task.action));
                let details = [format!("{} is here and checked; {why}", task.wanted.name)];
                self.feedback(&task.action, Execution::Downloaded, &details);
            }
            _ => {
                let Wanted { name, size, .. } = &task.wanted;
                self.say(Kind::Deployment, format!("action {}: {name}, {size} bytes", task.action));
                let resumed = self.record.has_begun(&task.action);
                let execution = if resumed { Execution::Resumed } else { Execution::Download };
                self.feedback(&task.action, execution, &[format!("{name}, {size} bytes")]);
                self.work = Work::Fetching { task, at: now, highest: 0, failures: 0, wrong: 0 };
            }
        }
    }

    /// The only file of the deployment that is for this device.
    fn choose(&self, deployment: &Deployment) -> Result<Wanted, String> {
        let Rules { part, artifact, size_most, .. } = &self.rules;
        let chunks =
            deployment.chunks.iter().filter(|chunk| part.as_ref().is_none_or(|part| *part == chunk.part));
        let files = chunks.flat_map(|chunk| &chunk.artifacts);
        let mut files = files.filter(|file| artifact.as_ref().is_none_or(|end| file.filename.ends_with(end)));
        let Some(file) = files.next() else {
            return Err(
                "the deployment has no file for this device: check its software modules, and part and \
                        artifact in the agent's configuration"
                    .to_string(),
            );
        };
        if let Some(other) = files.next() {
            return Err(format!(
                "the deployment has several files ({}, {}): say by part or artifact in the agent's configuration \
                 which is for this device",
                file.name(),
                other.name()
            ));
        }
        let of = |what: String| format!("{}: {what}", file.name());
        if file.size == 0 || file.size > *size_most {
            return Err(of(format!(
                "{} bytes are no firmware file: at most {size_most} are taken",
                file.size
            )));
        }
        let sha256 =
            file.sha256().ok_or_else(|| of("the server gives no SHA-256, so it is not taken".into()))?;
        let link =
            Artifact::link(file).ok_or_else(|| of("the server gives no link to it".into()))?.to_string();
        Ok(Wanted { name: file.name(), link, size: file.size, sha256 })
    }

    fn may_begin(&self, task: &Task) -> bool {
        // What was begun goes on: a device without a program is worse than one out of its window.
        self.record.has_begun(&task.action) || task.may_begin(self.rules.attempt)
    }

    /// Begins to change the device, when this is in the record.
    fn begin(&mut self) {
        if let Work::Ready { task, tries, .. } = std::mem::replace(&mut self.work, Work::None) {
            let first = !self.record.has_begun(&task.action);
            if first {
                self.record.begun = Some(RunningAction { action: task.action.clone(), kept: false });
                self.unsaved = true;
            }
            self.say(Kind::Progress, format!("action {}: the device is flashed", task.action));
            self.work = Work::Flashing { task, started: false, first, tries, progress: Progress::default() };
        }
    }

    /// What became of an attempt to fetch the file.
    pub(super) fn fetched(&mut self, now: Duration, piece: Piece) {
        let Work::Fetching { task, at, highest, failures, wrong } = &mut self.work else { return };
        let name = task.wanted.name.clone();
        let reached = match &piece {
            Piece::More { at } | Piece::Cut { at, .. } => *at,
            Piece::Whole | Piece::Wrong(_) => 0,
        };
        let is_further = reached > *highest;
        if is_further {
            (*highest, *failures) = (reached, 0);
        }
        match piece {
            Piece::Whole => {
                let task = task.clone();
                self.work = Work::Ready { task, at: now, fresh: false, reported: false, tries: 0 };
                // The deployment may have been cancelled or closed meanwhile.
                self.poll_early(now);
            }
            Piece::More { .. } if is_further => {}
            Piece::More { .. } | Piece::Cut { .. } => {
                *failures += 1;
                let failures = *failures;
                let (why, retry_after) = match piece {
                    Piece::Cut { why, retry_after, .. } => (why, retry_after),
                    _ => ("the server begins it anew each time".to_string(), None),
                };
                if failures > FETCHES_MOST {
                    let action = task.action.clone();
                    let why = format!("{name} cannot be fetched: {why} ({failures} attempts)");
                    return self.end(&action, false, vec![why]);
                }
                let pause = self.jitter.after(failures, self.rules.backoff);
                *at = now + pause.max(retry_after.unwrap_or_default().min(RETRY_MOST));
                self.say(Kind::Trouble, format!("{name}: {why}"));
            }
            Piece::Wrong(why) => {
                *wrong += 1;
                if *wrong >= WRONG_MOST {
                    let action = task.action.clone();
                    return self.end(&action, false, vec![format!("{name} was not flashed: {why}")]);
                }
                *at = now + self.jitter.after(*wrong, self.rules.backoff);
                self.say(Kind::Trouble, format!("{name}: {why}; it is fetched once more"));
            }
        }
    }

    /// Whether the record could be written.
    pub(super) fn saved(&mut self, now: Duration, result: Result<(), String>) {
        match result {
            Ok(()) => self.unsaved = false,
            Err(why) => self.trouble(now, format!("the state cannot be written: {why}"), None),
        }
    }

    /// The attributes of the device, or why there are none.
    pub(super) fn device_answered(&mut self, answer: Result<Vec<(String, String)>, String>) {
        self.query = DeviceQuery::No;
        match answer {
            Ok(attributes) => self.todo.push_back(Ask::Config(attributes)),
            Err(why) => self.say(Kind::Trouble, format!("the device does not tell about itself: {why}")),
        }
    }

    /// News of the update.
    pub(super) fn news(&mut self, news: News) {
        let Work::Flashing { task, progress, .. } = &mut self.work else { return };
        match news {
            News::Kept => {
                if let Some(begun) = self.record.begun.as_mut().filter(|begun| begun.action == task.action) {
                    self.unsaved |= !begun.kept;
                    begun.kept = true;
                }
            }
            News::Phase(words) => {
                progress.news = progress.count < TOLD_MOST;
                if progress.phases.len() < PHASES_MOST {
                    progress.phases.push(words.clone());
                }
                let words = format!("action {}: {words}", task.action);
                self.say(Kind::Progress, words);
            }
            News::Failed(update) => {
                let text = format!("action {}: the update of node {} has failed", task.action, update.node);
                let (controller, kind) = (self.name.clone(), Kind::Report);
                self.said.push(Message { controller, kind, text, update: Some(update) });
            }
            News::Percent(percent) => {
                // A repetition begins at 0 again.
                let percent = percent.min(100).max(progress.percent);
                progress.percent = percent;
                let worth = percent >= progress.reported.saturating_add(WORTH);
                progress.news |= worth && progress.count < TOLD_MOST;
            }
        }
    }

    /// What became of the order to flash.
    pub(super) fn flashed(&mut self, now: Duration, flashed: Flashed) {
        let Work::Flashing { task, first, tries, progress, .. } = &mut self.work else { return };
        let (task, first, tries) = (task.clone(), *first, *tries + 1);
        let phases = std::mem::take(&mut progress.phases);
        // An update without much to do ends before its plan was sent.
        if progress.news {
            for lines in phases.chunks(LINES_MOST) {
                self.feedback(&task.action, Execution::Proceeding, lines);
            }
        }
        match flashed {
            Flashed::Done(details) => self.end(&task.action, true, details),
            Flashed::Failed(details) => self.end(&task.action, false, details),
            Flashed::Interrupted => self.work = Work::None,
            Flashed::NotNow(why) => {
                if first {
                    self.record.begun = None;
                    self.unsaved = true;
                }
                let what = format!("the update waits: {why}");
                self.feedback(&task.action, Execution::Proceeding, std::slice::from_ref(&what));
                self.say(Kind::Trouble, format!("action {}: {what}", task.action));
                let at = now + self.jitter.after(tries, self.rules.backoff);
                self.work = Work::Ready { task, at, fresh: true, reported: false, tries };
            }
        }
    }

    /// Writes the end of an action into the record; it is reported to the server when it is there.
    fn end(&mut self, action: &str, ok: bool, mut details: Vec<String>) {
        // A failure before the device was asked says nothing of what an earlier attempt has done to it.
        let is_first = matches!(self.work, Work::Flashing { first: true, .. });
        if !ok && !is_first && self.record.has_begun(action) {
            details.push(BEGUN_EARLIER.to_string());
        }
        let words = details.join("; ");
        let kind = if ok { Kind::Updated } else { Kind::Failed };
        self.say(kind, format!("action {action}: {words}"));
        let details = ddi::lines(&details);
        self.record.end(Finish { action: action.to_string(), ok, details, reported: false });
        self.unsaved = true;
        self.work = Work::Ended { action: action.to_string() };
    }

    /// The server knows the end of an action.
    fn reported(&mut self, now: Duration, action: &str) {
        let mut ended = self.record.ended.iter_mut();
        if let Some(finish) = ended.find(|finish| finish.action == action && !finish.reported) {
            finish.reported = true;
            self.unsaved = true;
            // After an update the server may want the new attributes, or have more to do.
            if finish.ok {
                self.poll_early(now);
            }
        }
        self.work = match self.record.ended.iter().find(|finish| !finish.reported) {
            Some(finish) => Work::Ended { action: finish.action.clone() },
            None => Work::None,
        };
    }

    /// Polls before the pause that the server asks for is over, unless it did so before in this
    /// pause: a server that always has something new must not make the agent spin.
    fn poll_early(&mut self, now: Duration) {
        if self.early < EARLY_MOST {
            self.early += 1;
            self.poll_at = now;
            self.is_early = true;
        }
    }

    /// Puts a message on an action before the next requests.
    fn feedback(&mut self, action: &str, execution: Execution, details: &[String]) {
        let body = ddi::feedback(action, execution, Finished::None, None, details);
        self.todo.push_back(Ask::Tell { action: action.to_string(), body });
    }

    /// Something went wrong: after a pause, everything is asked anew.
    fn trouble(&mut self, now: Duration, why: String, retry_after: Option<Duration>) {
        self.failures += 1;
        let pause = self.jitter.after(self.failures, self.rules.backoff);
        let pause = pause.max(retry_after.unwrap_or_default().min(RETRY_MOST));
        self.hold = now + pause;
        self.poll_at = self.hold;
        self.todo.clear();
        self.say(Kind::Trouble, format!("{why}; again in {:.0} s", pause.as_secs_f64().ceil()));
    }

    fn say(&mut self, kind: Kind, text: String) {
        self.said.push(Message { controller: self.name.clone(), kind, text, update: None });
    }
}

/// Whether both are the same action with the same file.
fn same(one: &Task, other: &Task) -> bool {
    let key = |task: &Task| (task.action.clone(), task.wanted.size, task.wanted.sha256.clone());
    key(one) == key(other)
}

/// The last part of a link's path, if it can be an id.
fn last_part(link: &str) -> Option<String> {
    let path = link.split(['?', '#']).next()?;
    let id = path.rsplit('/').next()?;
    ddi::is_id(id).then(|| id.to_string())
}

#[cfg(test)]
mod tests;
