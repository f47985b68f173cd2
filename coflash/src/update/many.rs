//! The update of many devices over one bus: while one erases, another receives.

use std::sync::atomic::AtomicBool;
use std::sync::Arc;

use canopen::NodeId;

use super::content::Program;
use super::event::{Event, Report};
use super::flash::flash_program;
use super::left::{DeviceState, Left, Look};
use super::options::FlashOptions;
use crate::bus::{hub, Adapter, Gateway};
use crate::device::{Error, Session, Timing, Transfers};

/// The update of one device.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Job {
    /// The device.
    pub node: NodeId,
    /// The program.
    pub file: Program,
    /// The options.
    pub options: FlashOptions,
}

impl Job {
    /// An update of this device with this program.
    #[must_use]
    pub fn new(node: NodeId, file: impl Into<Program>, options: FlashOptions) -> Self {
        Self { node, file: file.into(), options }
    }
}

/// The options for all updates.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct ManyOptions {
    /// The time limits. Answers wait behind those of other devices, so the SDO time-out is
    /// multiplied by the number of devices that are updated at the same time.
    pub timing: Timing,
    /// The form of downloads.
    pub transfers: Transfers,
    /// How many devices are updated at the same time.
    pub at_once: usize,
    /// Ends all updates when it is set.
    pub cancelled: Arc<AtomicBool>,
}

impl ManyOptions {
    setters! {
        timing: Timing,
        transfers: Transfers,
        at_once: usize,
        cancelled: Arc<AtomicBool>,
    }
}

impl Default for ManyOptions {
    fn default() -> Self {
        Self {
            timing: Timing::default(),
            transfers: Transfers::default(),
            at_once: 8,
            cancelled: Arc::default(),
        }
    }
}

/// A failed update, and the state of the device.
#[derive(Debug)]
pub struct Failed {
    /// The error.
    pub error: Error,
    /// The state of the device.
    pub left: Left,
}

/// Updates all devices; if one fails, the others continue. `tell` gets the events of each job, on
/// separate threads. The results are in the order of the jobs.
pub fn flash_many(
    adapter: &mut dyn Adapter,
    jobs: &[Job],
    options: &ManyOptions,
    tell: &(dyn Fn(usize, Event) + Sync),
) -> Vec<Result<Report, Failed>> {
    let at_once = options.at_once.clamp(1, jobs.len().max(1));
    let sdo = options.timing.sdo.saturating_mul(at_once as u32);
    let timing = Timing { sdo, ..options.timing };
    let conversation = |(number, job): (usize, &Job)| -> (NodeId, hub::Conversation<'_, _>) {
        let (node, job, all) = (job.node, job.clone(), options.clone());
        let act = move |port: &mut hub::Port| {
            let mut session = Session::new(port, job.node, timing);
            let one = FlashOptions { follow: false, ..job.options };
            update(&mut session, &job, &one, &all, &mut |event| tell(number, event))
        };
        (node, Box::new(act))
    };
    let conversations = jobs.iter().enumerate().map(conversation).collect();
    hub::run(adapter, conversations, at_once)
}

/// Updates the devices behind a gateway one after the other, because a gateway does one transfer at
/// a time.
pub fn flash_in_turn(
    gateway: &mut dyn Gateway,
    jobs: &[Job],
    options: &ManyOptions,
    tell: &dyn Fn(usize, Event),
) -> Vec<Result<Report, Failed>> {
    let one = |(number, job): (usize, &Job)| {
        let mut session = Session::through(&mut *gateway, job.node, options.timing);
        update(&mut session, job, &job.options, options, &mut |event| tell(number, event))
    };
    jobs.iter().enumerate().map(one).collect()
}

/// Updates one of the devices.
fn update(
    session: &mut Session<'_>,
    job: &Job,
    one: &FlashOptions,
    all: &ManyOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Report, Failed> {
    session.cancel_by(all.cancelled.clone());
    session.transfer_by(all.transfers);
    let mut left = Left { state: DeviceState::Untouched, look: Look::NotAsked };
    let result = flash_program(session, &job.file, one, &mut |event| {
        left = event.left().unwrap_or(left);
        tell(event);
    });
    result.map_err(|error| Failed { error, left })
}
