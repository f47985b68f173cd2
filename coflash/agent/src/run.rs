//! A thread for each device, which joins the state machine, the server and the bus.

use std::fs::{self, File, TryLockError};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{channel, Receiver, RecvTimeoutError, Sender};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use crc::{Crc, CRC_64_XZ};

use super::backoff::Jitter;
use super::config::{Config, Target};
use super::controller::{Controller, Flash, Flashed, Kind, Message, News, Rules, Step};
use super::download::{self, Pause};
use super::firmware::{self, Content};
use super::http::{Client, Limits};
use super::record::{Record, Store};
use coflash_core::file::limit::MAX_FILE_SIZE;

/// What an agent does with its devices.
pub trait Devices: Sync {
    /// The attributes of a target for the server; an error is in words.
    ///
    /// # Errors
    /// In words, if the device does not answer.
    fn attributes(&self, target: &Target) -> Result<Vec<(String, String)>, String>;

    /// Flashes a device or those of a machine, and says what happens.
    fn flash(&self, order: Order<'_>, news: Sender<News>) -> Flashed;
}

/// An order to flash a target.
#[derive(Debug)]
#[non_exhaustive]
pub struct Order<'o> {
    /// The target.
    pub target: &'o Target,
    /// What it gets.
    pub content: Content<'o>,
    /// Whether an earlier agent has seen that the device keeps this program. If it runs, the order
    /// is carried out already.
    pub kept: bool,
    /// Whether an earlier agent has begun with this order: nobody knows what it has changed.
    pub begun: bool,
}

coflash_core::options! {
    /// The options of a run.
    #[derive(Clone, Debug)]
    pub struct Options {
        /// End when each device has nothing to do before its next poll.
        pub once: bool = false,
        /// The seed of the jitter.
        pub seed: u64 = 0,
        /// The time limits.
        pub times: Times = Times::default(),
        /// Ends the run when it is set.
        pub cancelled: Arc<AtomicBool> = Arc::default(),
    }
}

coflash_core::options! {
    /// The time limits of a run.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Times {
        /// The first pause after a failure; each further one is twice as long.
        pub backoff_first: Duration = Duration::from_secs(5),
        /// The longest pause after a failure.
        pub backoff_most: Duration = Duration::from_secs(300),
        /// The shortest pause between two messages of progress.
        pub progress: Duration = Duration::from_secs(5),
        /// How long a server may send nothing.
        pub silent: Duration = Duration::from_secs(20),
        /// How long a request may take, apart from files.
        pub request: Duration = Duration::from_secs(30),
        /// How long a file is fetched until the agent looks after other things, if the server can
        /// go on where it ended.
        pub piece: Duration = Duration::from_secs(60),
    }
}

/// How a run ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Ended {
    /// How many updates were successful.
    pub updated: usize,
    /// How many updates have failed.
    pub failed: usize,
    /// How many devices were not served: the server did not answer as it should, their bus was in
    /// use or absent, or their state file was damaged.
    pub unserved: usize,
}

/// The reason why an agent cannot start, in words.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct CannotStart(String);

/// How long a thread sleeps before it looks whether the run is to end.
const TICK: Duration = Duration::from_millis(200);
/// With `once`, how many failures in a row end the work for a device.
const ONCE_FAILURES: u32 = 4;

/// What a thread hears while it waits.
enum Heard {
    Attributes(Result<Vec<(String, String)>, String>),
    News(News),
    Flashed(Flashed),
}

/// What all threads share.
struct Shared<'r> {
    config: &'r Config,
    options: &'r Options,
    devices: &'r dyn Devices,
    report: &'r (dyn Fn(&Message) + Sync),
    client: Client,
    limits: Limits,
    store: Store,
    began: Instant,
}

/// Serves the devices until the run is cancelled, or with `once` until there is nothing to do.
///
/// # Errors
/// [`CannotStart`], before the first request.
pub fn run(
    config: &Config,
    options: &Options,
    devices: &dyn Devices,
    report: &(dyn Fn(&Message) + Sync),
) -> Result<Ended, CannotStart> {
    let folder = &config.state;
    let unusable = |error: &dyn std::fmt::Display| CannotStart(format!("{}: {error}", folder.display()));
    let store = Store::new(folder).map_err(|error| unusable(&error))?;
    let _lock = lock(folder.join("agent.lock")).map_err(|why| unusable(&why))?;
    // A lock of before can be taken in a folder that has become read-only or full.
    store.check().map_err(|error| unusable(&format!("no file can be written into it: {error}")))?;
    let Times { silent, request, .. } = options.times;
    let limits = Limits { silent, request };
    let (proxy, ca_file) = (config.proxy.as_deref(), config.ca_file.as_deref());
    let client = Client::new(config.server.clone(), proxy, ca_file, limits).map_err(CannotStart)?;
    let shared = Shared { config, options, devices, report, client, limits, store, began: Instant::now() };
    let shared = &shared;
    let results: Vec<Ended> = thread::scope(|scope| {
        let threads: Vec<_> =
            config.targets.iter().map(|target| scope.spawn(move || serve(shared, target))).collect();
        // A thread that panicked has served nobody.
        let lost = Ended { unserved: 1, ..Ended::default() };
        threads.into_iter().map(|thread| thread.join().unwrap_or(lost)).collect()
    });
    Ok(results.into_iter().fold(Ended::default(), |all, one| Ended {
        updated: all.updated + one.updated,
        failed: all.failed + one.failed,
        unserved: all.unserved + one.unserved,
    }))
}

/// Locks the folder, so that no second agent works with it.
fn lock(path: PathBuf) -> Result<File, String> {
    let file = File::options().write(true).create(true).truncate(false).open(path);
    let file = file.map_err(|error| error.to_string())?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err("another agent works with this folder: end it, or give each its own state".to_string())
        }
        Err(TryLockError::Error(error)) => Err(error.to_string()),
    }
}

/// The record of a device. A damaged one is said, and read again after a pause: it may be put right.
/// `None` if the run ends before that.
fn record(shared: &Shared<'_>, target: &Target, root: &str, seed: u64) -> Option<Record> {
    let Options { once, times, cancelled, .. } = shared.options;
    let mut jitter = Jitter::new(seed);
    for failures in 1.. {
        let why = match shared.store.load(&target.controller, root) {
            Ok(record) => return Some(record),
            Err(why) => why,
        };
        (shared.report)(&Message {
            controller: target.controller.clone(),
            kind: Kind::Trouble,
            text: why,
            update: None,
        });
        let until =
            shared.began.elapsed() + jitter.after(failures, (times.backoff_first, times.backoff_most));
        while !once && shared.began.elapsed() < until && !cancelled.load(Ordering::Relaxed) {
            thread::sleep(TICK.min(until.saturating_sub(shared.began.elapsed())));
        }
        if *once || cancelled.load(Ordering::Relaxed) {
            break;
        }
    }
    None
}

/// Serves one target.
fn serve(shared: &Shared<'_>, target: &Target) -> Ended {
    let Shared { config, options, .. } = *shared;
    let root = config.server.controller(&config.tenant, &target.controller);
    let seed = options.seed ^ Crc::<u64>::new(&CRC_64_XZ).checksum(target.controller.as_bytes());
    let Some(record) = record(shared, target, &root, seed) else {
        return Ended { unserved: 1, ..Ended::default() };
    };
    let Times { backoff_first, backoff_most, progress, .. } = options.times;
    let rules = Rules {
        part: target.part.clone(),
        artifact: target.artifact.clone(),
        attempt: target.attempt,
        confirm: target.confirm,
        size_most: MAX_FILE_SIZE,
        poll: config.poll,
        backoff: (backoff_first, backoff_most),
        progress,
    };
    let mut controller = Controller::new(&target.controller, rules, record, seed);
    let path = shared.store.path(&target.controller, "part");
    let (sender, heard) = channel();
    let mut ended = Ended::default();
    thread::scope(|scope| {
        loop {
            for said in controller.said() {
                match said.kind {
                    Kind::Updated => ended.updated += 1,
                    Kind::Failed => ended.failed += 1,
                    _ => {}
                }
                (shared.report)(&said);
            }
            let now = shared.began.elapsed();
            let over = options.cancelled.load(Ordering::Relaxed);
            let flashing = controller.is_flashing();
            let gives_up = options.once && controller.failures() >= ONCE_FAILURES && !flashing;
            if gives_up || options.once && controller.is_settled(now) {
                ended.unserved = usize::from(gives_up && !over);
                return;
            }
            match controller.next(now) {
                Step::Save(record) => {
                    let result = shared.store.save(&target.controller, &record);
                    if result.is_ok() && !controller.needs_file() {
                        // Without the file the next download begins anew, which is no harm.
                        let _ = fs::remove_file(&path);
                    }
                    controller.saved(shared.began.elapsed(), result);
                }
                // While the agent is being ended, only the end of an update is waited for.
                _ if over && !flashing => return,
                Step::Wait(until) => wait(shared, &mut controller, &heard, until),
                _ if over => wait(shared, &mut controller, &heard, now + TICK),
                Step::Ask(request) => {
                    let reply = shared.client.send(&root, &target.token, &request, shared.limits);
                    controller.answered(shared.began.elapsed(), reply);
                }
                Step::Fetch(wanted) => {
                    let ends = || options.cancelled.load(Ordering::Relaxed);
                    let pause = Pause { after: options.times.piece, now: &ends };
                    let piece = download::fetch(&shared.client, &target.token, &wanted, &path, &pause);
                    controller.fetched(shared.began.elapsed(), piece);
                }
                Step::AskDevice => {
                    let sender = sender.clone();
                    scope.spawn(move || {
                        let _ = sender.send(Heard::Attributes(shared.devices.attributes(target)));
                    });
                }
                Step::Flash(order) => {
                    let sender = sender.clone();
                    let path = &path;
                    scope.spawn(move || flash(shared, target, path.clone(), &order, &sender));
                }
            }
        }
    });
    ended
}

/// Waits for news, at most until this time.
fn wait(shared: &Shared<'_>, controller: &mut Controller, heard: &Receiver<Heard>, until: Duration) {
    let now = shared.began.elapsed();
    let pause = until.saturating_sub(now).clamp(Duration::from_millis(1), TICK);
    let mut next = heard.recv_timeout(pause);
    loop {
        let now = shared.began.elapsed();
        match next {
            Ok(Heard::Attributes(answer)) => controller.device_answered(answer),
            Ok(Heard::News(news)) => controller.news(news),
            Ok(Heard::Flashed(flashed)) => controller.flashed(now, flashed),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => return,
        }
        next = heard.recv_timeout(Duration::ZERO);
    }
}

/// Carries out an order, on a thread of its own.
fn flash(
    shared: &Shared<'_>,
    target: &Target,
    path: PathBuf,
    Flash { wanted, kept, begun }: &Flash,
    sender: &Sender<Heard>,
) {
    let (news, hear) = channel();
    let flashed = thread::scope(|scope| {
        scope.spawn(move || {
            for news in hear {
                let _ = sender.send(Heard::News(news));
            }
        });
        let bytes = download::bytes(&path, wanted).map_err(|why| vec![why]);
        let content = bytes.and_then(|bytes| firmware::content(&bytes, &wanted.name, target));
        match content {
            Ok(content) => shared.devices.flash(Order { target, content, kept: *kept, begun: *begun }, news),
            Err(lines) => {
                drop(news);
                Flashed::Failed(lines)
            }
        }
    });
    let _ = sender.send(Heard::Flashed(flashed));
}
