//! Runs the tasks of the engineer's page, by `coflash-core`.

use std::sync::Arc;
use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::{program, Address, NodeId};

use super::advice;
use super::firmware::Loaded;
use super::job::{Job, Step};
use super::shared::{lock, Shared, Work};
use super::state::{Notice, Phase, Readback, Report, State};
use coboot_can::{wall, Link};
use coflash_core::device::lss::{self, BitRate, LssAddress, Master};
use coflash_core::device::{info, scan, Error, ScanOptions, Session, Timing};
use coflash_core::file::Target;
use coflash_core::update::many::{Failed, Job as One};
use coflash_core::update::{self, steps, Event, FlashOptions, ManyOptions};

/// The most devices in an update at the same time.
const AT_ONCE: usize = 8;

impl Work for Job {
    fn enter(&self, state: &mut State) {
        self.entered(state);
    }

    fn run(self: Box<Self>, link: &mut Link, shared: &Shared) -> Notice {
        let done = match *self {
            Self::Scan => search(link, shared),
            Self::Update { nodes, file, program, trial, start, unlock } => {
                let options =
                    FlashOptions::default().program(program).trial_run(trial).start(start).unlock(unlock);
                return update_all(link, shared, &nodes, &file, options);
            }
            Self::Step { node, program, step } => step_of(link, shared, node, program, step),
            Self::Fastscan => fastscan(link, shared),
            Self::Assign { address, node, bit_rate, store } => {
                assign(link, shared, &address, node, bit_rate, store)
            }
        };
        done.unwrap_or_else(|error| Notice::error(&error))
    }
}

/// The notice for a task that needs frames behind a gateway.
fn no_bus(what: &str) -> Notice {
    let words = format!("a gateway carries only SDO: {what} needs the CAN bus itself");
    Notice::failed(words, "choose an adapter on the bus")
}

fn search(link: &mut Link, shared: &Shared) -> Result<Notice, Error> {
    let Link::Bus(adapter) = link else { return Ok(no_bus("searching the bus")) };
    let found = scan(&mut **adapter, &ScanOptions::default(), &shared.cancelled)?;
    shared.change(|state| state.found(&found));
    Ok(Notice::done(match found.len() {
        0 => "no node answers, and no node was heard; fastscan below finds devices without a node-ID"
            .to_string(),
        1 => "1 device found".to_string(),
        count => format!("{count} devices found"),
    }))
}

/// A session that the page can cancel.
fn session<'l>(link: &'l mut Link, shared: &Shared, node: NodeId) -> Session<'l> {
    let mut session = Session::on(link, node, Timing::default());
    session.cancel_by(shared.cancelled.clone());
    session
}

/// Reads a device again, so that the table is right. An error here does not change the result of
/// the previous task.
fn read_again(link: &mut Link, shared: &Shared, node: NodeId) {
    let mut session = Session::on(link, node, Timing::default().boot(Duration::from_secs(1)));
    let answer = info(&mut session);
    shared.change(|state| match answer {
        Ok(info) => state.update_device(&info),
        Err(_) => state.silent(node),
    });
}

fn step_of(link: &mut Link, shared: &Shared, node: NodeId, number: u8, step: Step) -> Result<Notice, Error> {
    let done = single(&mut session(link, shared, node), shared, number, step);
    if !matches!(done, Err(Error::Adapter(_))) {
        read_again(link, shared, node);
    }
    done
}

fn single(session: &mut Session<'_>, shared: &Shared, number: u8, step: Step) -> Result<Notice, Error> {
    let node = session.node();
    let mut note = |event: Event| {
        let words = advice::with_advice(&event, event.advice());
        shared.change(|state| state.task.as_mut().map(|task| task.words = format!("node {node}: {words}")));
    };
    let words = match step {
        Step::CallBack => {
            steps::enter_bootloader(session, &mut note)?;
            "the bootloader is running".to_string()
        }
        Step::Erase => {
            steps::enter_bootloader(session, &mut note)?;
            steps::erase_at_once(session, number)?;
            format!("program {number} is erased")
        }
        Step::Release => {
            note(Event::Found(session.find()?));
            steps::release(session, number, &mut note)?;
            format!("program {number} is released for autostart")
        }
        Step::Withhold => {
            note(Event::Found(session.find()?));
            steps::withdraw(session, number)?;
            format!("program {number} is no longer released: it does not start by itself")
        }
        Step::Start => {
            let running = session.find()?;
            if running.is_bootloader() {
                format!("{} is running", steps::start(session, number)?)
            } else {
                format!("{running} is running already")
            }
        }
        Step::ReadBack => {
            let at = Address::new(program::PROGRAM_DATA, number);
            let bytes = session.upload(at, &mut |_| {})?;
            let size = bytes.len();
            *lock(&shared.readback) = Some(Arc::new(bytes));
            shared.change(|state| {
                state.readback = Some(Readback { node: node.get(), program: number, size });
            });
            format!("program {number} was read, {size} bytes")
        }
    };
    Ok(Notice::done(format!("node {node}: {words}")))
}

/// Downloads the file into many devices, and makes a report of each.
fn update_all(
    link: &mut Link,
    shared: &Shared,
    nodes: &[NodeId],
    file: &Loaded,
    options: FlashOptions,
) -> Notice {
    let jobs: Vec<One> = nodes
        .iter()
        .map(|node| One::new(*node, file.program.clone(), for_node(shared, file, *node, options)))
        .collect();
    let many = ManyOptions::default().at_once(AT_ONCE).cancelled(shared.cancelled.clone());
    let note = |number: usize, event: Event| {
        if let Some(job) = jobs.get(number) {
            shared.record(job.node, &event);
        }
        shared.change(|state| {
            if let Some(update) = state.updates.get_mut(number) {
                update.event(&event);
            }
        });
    };
    let began = wall();
    let mut results = match link {
        Link::Bus(adapter) => update::flash_many(&mut **adapter, &jobs, &many, &note),
        Link::Gateway(gateway) => update::flash_in_turn(&mut **gateway, &jobs, &many, &note),
    };
    let failed = results.iter().filter(|result| result.is_err()).count();
    shared.change(|state| {
        state.recall(nodes, &mut results);
        for (update, result) in state.updates.iter_mut().zip(&results) {
            match result {
                Ok(report) => {
                    (update.phase, update.done) = (Phase::Done, update.total);
                    update.words = report.to_string();
                }
                Err(Failed { error, left }) => {
                    update.failed(error, &advice::with_advice(left, left.advice()))
                }
            }
        }
    });
    let lost = |result: &Result<_, Failed>| matches!(result, Err(Failed { error: Error::Adapter(_), .. }));
    if !results.iter().any(lost) {
        nodes.iter().for_each(|node| read_again(link, shared, *node));
    }
    report(shared, nodes, file, options.program, &results, wall().saturating_sub(began));
    let good = results.len() - failed;
    let done =
        if file.shown.is_bootloader { "devices have the bootloader of" } else { "devices updated with" };
    let words = format!("{good} of {} {done} {}", results.len(), file.shown.name);
    match results.into_iter().find_map(Result::err) {
        None => Notice::done(words),
        Some(Failed { error, .. }) => Notice::failed(words, advice::on_page(&error.advice())),
    }
}

/// Adds the check that the device is the target of the file, if both give their identity.
fn for_node(shared: &Shared, file: &Loaded, node: NodeId, options: FlashOptions) -> FlashOptions {
    let product = shared.read(|state| {
        let device = state.devices.as_ref().and_then(|devices| devices.get(&node.get()))?;
        device.product()
    });
    let target = match (file.shown.vendor_id, file.shown.product_code) {
        (Some(vendor_id), Some(product_code)) => Some(Target { vendor_id, product_code }),
        _ => None,
    };
    options.check_target(target.filter(|_| product.is_some()))
}

fn report(
    shared: &Shared,
    nodes: &[NodeId],
    file: &Loaded,
    program: u8,
    results: &[Result<update::Report, Failed>],
    took: Duration,
) {
    shared.change(|state| {
        let run = state.reports.last().map_or(1, |report| report.run + 1);
        for (node, result) in nodes.iter().zip(results) {
            let device = state.devices.as_ref().and_then(|devices| devices.get(&node.get())).cloned();
            let words = match result {
                Ok(report) if report.renewal.is_some() => {
                    report.renewal.map(|renewal| renewal.to_string()).unwrap_or_default()
                }
                Ok(report) if report.running.is_some() => "updated, and the program runs".to_string(),
                Ok(_) => "updated".to_string(),
                Err(Failed { error, left }) => {
                    format!("failed: {error}; the device: {}", advice::with_advice(left, left.advice()))
                }
            };
            let report = Report {
                number: state.reports.last().map_or(1, |last| last.number + 1),
                run,
                date: wall().as_secs(),
                node: node.get(),
                ok: result.is_ok(),
                words,
                device: device.as_ref().and_then(|device| device.name.clone()),
                serial_number: device.as_ref().and_then(|device| device.identity[3]),
                file: file.shown.name.clone(),
                crc: device
                    .as_ref()
                    .filter(|device| device.answers)
                    .and_then(|device| device.program(program)?.crc),
                file_crc: file.shown.crc,
                version: device.filter(|device| device.answers).and_then(|device| device.software),
                file_version: file.shown.version.clone(),
                seconds: result.as_ref().map_or(took, |report| report.took).as_secs_f64(),
                adapter: state.adapter.url.clone(),
                tool: shared.tool.clone(),
            };
            state.report(report);
        }
    });
}

fn fastscan(link: &mut Link, shared: &Shared) -> Result<Notice, Error> {
    let Link::Bus(adapter) = link else { return Ok(no_bus("fastscan")) };
    let mut master = Master::new(&mut **adapter, lss::ANSWER);
    master.cancel_by(shared.cancelled.clone());
    shared.change(|state| state.lss = None);
    master.switch_all(false)?;
    let found = master.fastscan(&mut |bits| {
        let percent = bits * 100 / 128;
        shared.change(|state| state.task.as_mut().map(|task| task.percent = Some(percent)));
    });
    // Switch back first: the device is selected again for its settings, and no other device may
    // listen then.
    let back = master.switch_all(false);
    let found = found?;
    back?;
    shared.change(|state| state.lss = found);
    Ok(match found {
        Some(address) => Notice::done(format!(
            "found a device without a node-ID, serial number {:08X}h: set one below",
            address.serial_number
        )),
        None => Notice::done("there is no device without a node-ID on the bus"),
    })
}

fn assign(
    link: &mut Link,
    shared: &Shared,
    address: &LssAddress,
    node: Option<NodeId>,
    bit_rate: Option<BitRate>,
    store: bool,
) -> Result<Notice, Error> {
    let Link::Bus(adapter) = link else { return Ok(no_bus("giving a node-ID")) };
    let mut master = Master::new(&mut **adapter, lss::ANSWER);
    master.cancel_by(shared.cancelled.clone());
    master.switch_all(false)?;
    master.select(address)?;
    let given = give(&mut master, node, bit_rate, store);
    let back = master.switch_all(false);
    let old = given?;
    back?;
    let mut words = Vec::new();
    if let Some(node) = node {
        // A device with another node-ID takes the new one when its communication is reset.
        if let Some(old) = old.filter(|old| *old != node) {
            adapter.send(&NmtCommand::ResetCommunication.emit(Some(old))).map_err(Error::Adapter)?;
        }
        words.push(format!("the device is node {node} now"));
        shared.change(|state| {
            if let (Some(devices), Some(old)) = (&mut state.devices, old) {
                devices.remove(&old.get());
            }
        });
    }
    if let Some(rate) = bit_rate.and_then(BitRate::bits_per_second) {
        words.push(of_bit_rate(rate / 1000, store));
    }
    words
        .push(if store { "stored" } else { "not stored: the setting is lost at the next start" }.to_string());
    shared.change(|state| state.lss = None);
    if let Some(node) = node {
        read_again(link, shared, node);
    }
    Ok(Notice::done(words.join("; ")))
}

/// What becomes of a bit rate: without being stored, it is not there any more at the next start.
fn of_bit_rate(rate: u32, is_stored: bool) -> String {
    match is_stored {
        true => format!("it switches to {rate} kbit/s at its next start"),
        false => format!("it is given {rate} kbit/s, and does not switch to it yet"),
    }
}

/// Sends the settings to the selected device; returns its previous node-ID.
fn give(
    master: &mut Master<'_>,
    node: Option<NodeId>,
    bit_rate: Option<BitRate>,
    store: bool,
) -> Result<Option<NodeId>, Error> {
    let old = master.inquire_node_id()?;
    if node.is_some() {
        master.set_node_id(node)?;
    }
    if let Some(rate) = bit_rate {
        master.set_bit_rate(rate)?;
    }
    if store {
        master.store()?;
    }
    Ok(old)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bit_rate_that_is_not_stored_is_not_that_of_the_next_start() {
        let words = [true, false].map(|is_stored| of_bit_rate(500, is_stored).contains("at its next start"));
        assert_eq!(words, [true, false]);
    }
}
