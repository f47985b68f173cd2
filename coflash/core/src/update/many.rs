//! The update of many devices over one bus: while one erases, another receives, and devices with a
//! second SDO server receive the same program together.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

use canopen::frame::Channel;
use canopen::{CobId, NodeId};

use super::device_after::{DeviceAfterUpdate, DeviceAnswer, DeviceState};
use super::event::{Event, Note, Report, Warning};
use super::options::FlashOptions;
use super::payload::Payload;
use super::pipeline::flash_knowing;
use super::running::Known;
use crate::device::{Error, Session, Timing, Transfers};
use coboot_can::{hub, Adapter, Gateway};

/// The update of one device.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Job {
    /// The device.
    pub node: NodeId,
    /// What it gets.
    pub file: Payload,
    /// The options.
    pub options: FlashOptions,
    /// What is known of the device from an earlier attempt.
    pub known: Known,
}

impl Job {
    /// An update of this device with this program.
    #[must_use]
    pub fn new(node: NodeId, file: impl Into<Payload>, options: FlashOptions) -> Self {
        Self { node, file: file.into(), options, known: Known::default() }
    }
}

options! {
    /// The options for all updates.
    #[derive(Clone, Debug)]
    pub struct ManyOptions {
        /// The time limits. Requests wait for those to other devices: with several devices at the
        /// same time, the SDO time-out of a block is multiplied by their number, and that of other
        /// requests is doubled outside of a group.
        pub timing: Timing = Timing::default(),
        /// The form of downloads.
        pub transfers: Transfers = Transfers::default(),
        /// How many devices are updated at the same time. A device that waits for its group does
        /// not count.
        pub at_once: usize = 8,
        /// Whether devices that can are updated together: data blocks go to all of them in one
        /// download.
        pub together: bool = true,
        /// Ends all updates when it is set.
        pub cancelled: Arc<AtomicBool> = Arc::default(),
    }
}

/// A failed update, and the state of the device.
#[derive(Debug)]
pub struct Failed {
    /// The error.
    pub error: Error,
    /// The state of the device.
    pub left: DeviceAfterUpdate,
}

/// The COB-ID of requests to a group. The predefined connection set has no other use for it, and
/// for those of the answers.
const GROUP: u16 = 0x6DF;
/// The base of the COB-IDs of answers, to which the node-ID is added.
const GROUP_ANSWERS: u16 = 0x680;

/// Updates all devices; if one fails, the others continue. A device that fails in a group is
/// updated once more, without the others. Bootloaders are renewed after that, one after the other; if the
/// first one fails, the others are not touched. `on_event` gets the events of each job, on separate threads.
/// The results are in the order of the jobs.
pub fn flash_many(
    adapter: &mut dyn Adapter,
    jobs: &[Job],
    options: &ManyOptions,
    on_event: &(dyn Fn(usize, Event) + Sync),
) -> Vec<Result<Report, Failed>> {
    // A device alone can be followed to another node-ID, which lifts need.
    if let [job] = jobs {
        let mut session = Session::new(adapter, job.node, options.timing);
        let show = &mut |event| on_event(0, event);
        return vec![update(&mut session, job, &job.options, options, &mut job.known.clone(), show)];
    }
    let numbered = || jobs.iter().enumerate();
    let programs: Vec<(usize, &Job)> = numbered().filter(|(_, job)| !job.file.is_bootloader()).collect();
    let channels = if options.together { channels(&programs) } else { vec![None; programs.len()] };
    let all: Vec<Planned<'_>> = programs
        .into_iter()
        .zip(channels)
        .map(|((number, job), channel)| Planned { number, job, channel, known: job.known })
        .collect();
    let mut results: BTreeMap<usize, Result<Report, Failed>> = BTreeMap::new();
    let mut again: Vec<Planned<'_>> = Vec::new();
    let ends = flash_each(adapter, &all, options, on_event);
    for (plan, end) in all.into_iter().zip(ends) {
        if end.is_for_another {
            again.push(Planned { channel: None, known: end.known, ..plan });
        }
        results.insert(plan.number, end.result);
    }
    let ends = flash_each(adapter, &again, options, on_event);
    results.extend(again.iter().map(|plan| plan.number).zip(ends.into_iter().map(|end| end.result)));
    let mut fate = Fate::default();
    for (number, job) in numbered().filter(|(_, job)| job.file.is_bootloader()) {
        let plan = [Planned { number, job, channel: None, known: job.known }];
        let alone = ManyOptions { at_once: 1, ..options.clone() };
        let renew = || flash_each(adapter, &plan, &alone, on_event).into_iter().map(|end| end.result).next();
        results.extend(fate.of(job, renew).map(|result| (number, result)));
    }
    results.into_values().collect()
}

/// What became of the first bootloader: if it is not renewed, the others are not touched.
#[derive(Default)]
struct Fate {
    first: Option<(NodeId, bool)>,
}

impl Fate {
    /// The result of this renewal.
    fn of(
        &mut self,
        job: &Job,
        renew: impl FnOnce() -> Option<Result<Report, Failed>>,
    ) -> Option<Result<Report, Failed>> {
        if let Some((first, false)) = self.first {
            let left = DeviceAfterUpdate { state: DeviceState::Untouched, answer: DeviceAnswer::NotAsked };
            return Some(Err(Failed { error: Error::FirstFailed { first }, left }));
        }
        let result = renew()?;
        self.first.get_or_insert((job.node, result.is_ok()));
        Some(result)
    }
}

/// A job with its place among all, and its part in the group.
struct Planned<'j> {
    number: usize,
    job: &'j Job,
    channel: Option<Channel>,
    /// What is known of the device before this attempt.
    known: Known,
}

/// The end of an attempt.
struct End {
    result: Result<Report, Failed>,
    /// What is known of the device after it.
    known: Known,
    /// The device gets another attempt, without the others.
    is_for_another: bool,
}

/// The COB-IDs for the jobs that can be done together: those that have a COB-ID for answers, if there
/// are several.
fn channels(jobs: &[(usize, &Job)]) -> Vec<Option<Channel>> {
    if jobs.len() < 2 {
        return vec![None; jobs.len()];
    }
    let of = |(_, job): &(usize, &Job)| {
        let response = GROUP_ANSWERS + u16::from(job.node.get());
        if response >= GROUP {
            return None;
        }
        Some(Channel { request: CobId::new(GROUP)?, response: CobId::new(response)? })
    };
    jobs.iter().map(of).collect()
}

/// One attempt for each of these jobs.
fn flash_each(
    adapter: &mut dyn Adapter,
    jobs: &[Planned<'_>],
    options: &ManyOptions,
    on_event: &(dyn Fn(usize, Event) + Sync),
) -> Vec<End> {
    let at_once = options.at_once.clamp(1, jobs.len().max(1));
    // Without a group, a request may have to wait for the segments of another transfer.
    let timing = |plan: &Planned<'_>| match (at_once, plan.channel) {
        (1, _) | (_, Some(_)) => options.timing,
        _ => Timing { sdo: options.timing.sdo.saturating_mul(2), ..options.timing },
    };
    let conversation = |plan: &Planned<'_>| {
        let (number, job, all, timing) = (plan.number, plan.job.clone(), options.clone(), timing(plan));
        let mut known = plan.known;
        let act = move |port: &mut hub::Port| {
            let mut session = Session::new(port, job.node, timing);
            session.share_with(at_once as u32);
            let one = FlashOptions { follow: false, ..job.options };
            let (mut done, mut was_in_group) = (None, false);
            let result = update(&mut session, &job, &one, &all, &mut known, &mut |event| match event {
                Event::Done(_) => done = Some(event),
                event => {
                    was_in_group |= matches!(event, Event::Note(Note::Together { .. }));
                    on_event(number, event);
                }
            });
            let is_over = |error: &Error| {
                let cancelled = all.cancelled.load(Ordering::Relaxed);
                cancelled || matches!(error, Error::Adapter(_) | Error::Cancelled)
            };
            let is_for_another = was_in_group && result.as_ref().is_err_and(|failed| !is_over(&failed.error));
            match (&result, done) {
                // This is not the end.
                (Err(failed), _) if is_for_another => {
                    on_event(number, Warning::Apart { why: failed.error.to_string() }.into());
                }
                (_, Some(done)) => on_event(number, done),
                _ => {}
            }
            End { result, known, is_for_another }
        };
        let act: hub::Act<'_, _> = Box::new(act);
        hub::Conversation { node: plan.job.node, channel: plan.channel, act }
    };
    // Devices of a group have nothing else to do than to answer.
    let limits =
        hub::Options { at_once, answer: options.timing.sdo / 2, cancelled: options.cancelled.clone() };
    hub::run(adapter, jobs.iter().map(conversation).collect(), &limits)
}

/// Updates the devices behind a gateway one after the other, because a gateway does one transfer at
/// a time. If the first renewal of a bootloader fails, the other bootloaders are not touched.
pub fn flash_in_turn(
    gateway: &mut dyn Gateway,
    jobs: &[Job],
    options: &ManyOptions,
    on_event: &dyn Fn(usize, Event),
) -> Vec<Result<Report, Failed>> {
    let mut one = |(number, job): (usize, &Job)| {
        let mut session = Session::through(&mut *gateway, job.node, options.timing);
        let show = &mut |event| on_event(number, event);
        update(&mut session, job, &job.options, options, &mut job.known.clone(), show)
    };
    let mut fate = Fate::default();
    let each = |(number, job): (usize, &Job)| {
        if job.file.is_bootloader() {
            fate.of(job, || Some(one((number, job))))
        } else {
            Some(one((number, job)))
        }
    };
    jobs.iter().enumerate().filter_map(each).collect()
}

/// Updates one of the devices.
fn update(
    session: &mut Session<'_>,
    job: &Job,
    one: &FlashOptions,
    all: &ManyOptions,
    known: &mut Known,
    on_event: &mut dyn FnMut(Event),
) -> Result<Report, Failed> {
    session.cancel_by(all.cancelled.clone());
    session.transfer_by(all.transfers);
    let mut left = DeviceAfterUpdate { state: known.state(), answer: DeviceAnswer::NotAsked };
    let result = flash_knowing(session, &job.file, one, known, &mut |event| {
        left = event.left().unwrap_or(left);
        on_event(event);
    });
    result.map_err(|error| Failed { error, left })
}
