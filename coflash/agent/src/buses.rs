//! The devices: flashes them and asks them for their attributes.
//!
//! Devices of one bus whose orders come while the bus is in use are updated together, once it is
//! free.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{channel, Sender};
use std::sync::{Arc, Mutex, PoisonError};

use super::config::{Device, Target, TargetKind};
use super::controller::{Flashed, News};
use super::firmware::Content;
use super::machine;
use super::progress::{failure, waits, Shown};
use super::run::{Devices, Order};
use coboot_can::Link;
use coflash_core::device::lock::Lock;
use coflash_core::device::state::{source, supply};
use coflash_core::device::{info, DeviceInfo, Error, Session, Timing};
use coflash_core::update::many::{flash_in_turn, flash_many, Failed, Job, ManyOptions};
use coflash_core::update::{Event, FlashOptions, Known, Payload, Report};

/// Opens a bus by its URL; an error is in words.
pub type Open<'o> = &'o (dyn Fn(&str) -> Result<Link, String> + Sync);

/// The buses of an agent.
pub struct Buses<'o> {
    open: Open<'o>,
    buses: Mutex<BTreeMap<String, Arc<Bus>>>,
    cancelled: Arc<AtomicBool>,
}

/// A bus, and the orders that wait for it.
#[derive(Default)]
struct Bus {
    waiting: Mutex<Vec<Waiting>>,
    /// Held by whoever works on the bus.
    turn: Mutex<()>,
}

struct Waiting {
    job: Job,
    kept: bool,
    news: Sender<News>,
    done: Sender<Flashed>,
}

impl fmt::Debug for Buses<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Buses").finish_non_exhaustive()
    }
}

/// No thread panics while it holds a lock; and if one did, the values stay valid.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<'o> Buses<'o> {
    /// Buses that are opened for each piece of work, and ended by `cancelled`.
    #[must_use]
    pub fn new(open: Open<'o>, cancelled: Arc<AtomicBool>) -> Self {
        Self { open, buses: Mutex::default(), cancelled }
    }

    fn bus(&self, url: &str) -> Arc<Bus> {
        lock(&self.buses).entry(url.to_string()).or_default().clone()
    }

    /// Carries out all orders that wait for the bus.
    fn work(&self, url: &str, waiting: Vec<Waiting>) {
        let shown = Shown::default();
        let mut link = match (self.open)(url) {
            Ok(link) => shown.on(link),
            Err(why) => {
                for order in waiting {
                    let _ = order.done.send(Flashed::NotNow(why.clone()));
                }
                return;
            }
        };
        let mut locks = Vec::new();
        let mut orders = Vec::new();
        for order in waiting {
            match Lock::of(url, order.job.node) {
                Ok(lock) => locks.push(lock),
                Err(error) => {
                    let _ = order.done.send(Flashed::NotNow(error.to_string()));
                    continue;
                }
            }
            let mut session = Session::on(&mut link, order.job.node, Timing::default());
            session.cancel_by(self.cancelled.clone());
            let (marks, number) = (order.job.file.marks(), order.job.options.program);
            if order.kept && marks.is_running(&mut session, number).is_ok_and(|runs| runs) {
                let words = "the device has run this program since before the agent was restarted";
                let _ = order.done.send(Flashed::Done(vec![words.to_string(), of(&order.job.file)]));
                continue;
            }
            orders.push(order);
        }
        let jobs: Vec<Job> = orders.iter().map(|order| order.job.clone()).collect();
        let options = ManyOptions::default().cancelled(self.cancelled.clone());
        let report = |number: usize, event: Event| {
            let order = &orders[number];
            for news in shown.news(order.job.node, &event) {
                let _ = order.news.send(news);
            }
        };
        let results = match &mut link {
            Link::Bus(adapter) => flash_many(&mut **adapter, &jobs, &options, &report),
            Link::Gateway(gateway) => flash_in_turn(&mut **gateway, &jobs, &options, &report),
        };
        for (order, result) in orders.iter().zip(results) {
            let _ = order.done.send(flashed(&order.job, result));
        }
    }
}

impl Devices for Buses<'_> {
    fn attributes(&self, target: &Target) -> Result<Vec<(String, String)>, String> {
        let TargetKind::Device(device) = &target.what else {
            // A scan would end the transfers of other tools, only to report this.
            return Ok(of_agent(target));
        };
        let bus = self.bus(&target.bus);
        let _turn = lock(&bus.turn);
        let mut link = (self.open)(&target.bus)?;
        let mut session = Session::on(&mut link, device.node, Timing::default());
        session.cancel_by(self.cancelled.clone());
        let info = info(&mut session).map_err(|error| format!("{error}: {}", error.advice()))?;
        Ok(attributes(target, device, &info))
    }

    fn flash(&self, order: Order<'_>, news: Sender<News>) -> Flashed {
        let Order { target, content, kept, begun } = order;
        let known = if begun { Known::begun() } else { Known::default() };
        match content {
            Content::Program(device, program) => self.device(target, job(device, program, known), kept, news),
            Content::Package(machine, package) => {
                self.machine(target, &machine::Order { package: &package, machine, known }, &news)
            }
        }
    }
}

impl Buses<'_> {
    /// Updates a device, together with those that wait for the same bus.
    fn device(&self, target: &Target, job: Job, kept: bool, news: Sender<News>) -> Flashed {
        let (done, result) = channel();
        let bus = self.bus(&target.bus);
        lock(&bus.waiting).push(Waiting { job, kept, news, done });
        let _turn = lock(&bus.turn);
        // Another thread may have carried this order out together with its own.
        if let Ok(flashed) = result.try_recv() {
            return flashed;
        }
        if self.cancelled.load(Ordering::Relaxed) {
            return Flashed::Interrupted;
        }
        let waiting = std::mem::take(&mut *lock(&bus.waiting));
        self.work(&target.bus, waiting);
        // Every order gets its result. If it did not, the update would be begun anew.
        result.try_recv().unwrap_or(Flashed::Interrupted)
    }

    /// Updates a machine, when the bus is free.
    fn machine(&self, target: &Target, order: &machine::Order<'_>, news: &Sender<News>) -> Flashed {
        let bus = self.bus(&target.bus);
        let _turn = lock(&bus.turn);
        if self.cancelled.load(Ordering::Relaxed) {
            return Flashed::Interrupted;
        }
        match (self.open)(&target.bus) {
            Ok(link) => {
                let ended = machine::update(link, &target.bus, order, &self.cancelled, news);
                ended.unwrap_or_else(|ended| ended)
            }
            Err(why) => Flashed::NotNow(why),
        }
    }
}

/// The update of a device with a program.
fn job(device: &Device, program: Payload, known: Known) -> Job {
    let options = FlashOptions::default()
        .program(device.program)
        .check_target(program.target().filter(|_| device.check_target))
        .trial_run(device.trial_run)
        .verify(device.verify);
    let mut job = Job::new(device.node, program, options);
    job.known = known;
    job
}

/// A program in words.
fn of(program: &Payload) -> String {
    let kind = if program.is_bootloader() { "bootloader" } else { "program" };
    format!("{kind} of {} bytes, CRC {:08X}h", program.size(), program.crc())
}

/// The result of an update for the server.
fn flashed(job: &Job, result: Result<Report, Failed>) -> Flashed {
    match result {
        Ok(report) => Flashed::Done(vec![report.to_string(), of(&job.file)]),
        Err(Failed { error: Error::Cancelled, .. }) => Flashed::Interrupted,
        Err(failed) => match waits(&failed) {
            Some(why) => Flashed::NotNow(why),
            None => Flashed::Failed(failure(&failed)),
        },
    }
}

/// What the server gets to know of any target.
fn of_agent(target: &Target) -> Vec<(String, String)> {
    vec![
        ("bus".to_string(), target.bus.clone()),
        ("coflash".to_string(), env!("CARGO_PKG_VERSION").to_string()),
    ]
}

/// What the server gets to know of a device: what `coflash info` shows.
fn attributes(target: &Target, device: &Device, info: &DeviceInfo) -> Vec<(String, String)> {
    let mut all = of_agent(target);
    all.push(("node".to_string(), device.node.to_string()));
    all.push(("runs".to_string(), info.device_type.to_string()));
    let texts =
        [("name", &info.name), ("hardware", &info.hardware_version), ("software", &info.software_version)];
    for (key, text) in texts {
        all.extend(text.iter().map(|text| (key.to_string(), text.clone())));
    }
    for (key, number) in
        ["vendor_id", "product_code", "revision", "serial_number"].into_iter().zip(info.identity)
    {
        all.extend(number.map(|number| (key.to_string(), format!("{number:08X}h"))));
    }
    if let Some(state) = info.state {
        all.extend(state.stays().map(|why| ("stays".to_string(), why)));
        all.extend(state.last_reset().map(|words| ("last_reset".to_string(), words)));
        all.extend(state.ended_by().map(|by| ("program_ended_by".to_string(), source(by).to_string())));
        all.push(("crash_resets".to_string(), state.crash_resets.to_string()));
        all.extend(state.option_bytes.map(|options| ("option_bytes".to_string(), options.to_string())));
        all.extend(supply(state.supply).map(|words| ("supply".to_string(), words.to_string())));
    }
    all.extend(info.bootloader.map(|bootloader| ("bootloader".to_string(), bootloader.version.to_string())));
    for program in &info.programs {
        let key = |what: &str| format!("program_{}_{what}", program.number);
        let crc = program.crc.filter(|crc| *crc != 0);
        all.extend(crc.map(|crc| (key("crc"), format!("{crc:08X}h"))));
        all.extend(program.release().map(|version| (key("version"), version.to_string())));
    }
    all
}
