//! A device: the firmware's boot stage and tasks around `boot-core`, without a chip.
//!
//! A START leaves a request and resets the device, as on the chip, and so does everything else that
//! ends the bootloader; the boot decision is then made again. If it selects a program, no CPU can
//! run it: the device is silent from then on, or a [stand-in](crate::stand_in) answers, alone or for a
//! [process of the host](crate::run).

use std::io;
use std::time::Duration;

use boot_core::bootloader::{self, Bootloader, Choices};
use boot_core::canopen::node::{self, NmtPolicy, Node};
use boot_core::canopen::od::Entry;
use boot_core::canopen::program::ProgramStart;
use boot_core::canopen::slave::{self, Output, Slave, SlaveDevice};
use boot_core::canopen::{CobId, Frame, Instant, NodeId};
use boot_core::control::{Sealed, Step};
use boot_core::decision::{self, choose, Exit, Images, Policy, Store, Woken};
use boot_core::flash::{run, Flash as _};
use boot_core::store::{Journal, Key, NodeParameters, Parameters as _};
use coboot_app::{Defaults, Next, Start};
use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;
use shared_abi::warm_start::{BootRequest, Owed};

use crate::file_flash::FileFlash;
use crate::run::{Command, Ending, Place, Process};
use crate::stand_in::StandIn;
use crate::supports;

/// The bytes of blocks that may wait for the flash, as in the firmware for the STM32F407.
pub const BUFFER: usize = 80 * 1024;
/// How long a device waits after the answer to the command that makes it leave, in ms: clients must
/// get the answer before anything else happens.
const ANSWER_TO_RESET_MS: u32 = 15;
/// The file is never older than this while the flash changes.
const SAVE_AFTER: Duration = Duration::from_millis(250);
/// The numbers of its programs, which all start by themselves.
const PROGRAM_NUMBERS: [u8; 2] = [1, 2];

/// A bootloader with everything, which starts its programs by itself.
struct Ours<const PROGRAMS: usize>;

impl<const PROGRAMS: usize> Choices for Ours<PROGRAMS> {
    const PROGRAM_START: ProgramStart = ProgramStart {
        by_itself: match PROGRAMS {
            1 => [PROGRAM_NUMBERS[0], 0],
            _ => PROGRAM_NUMBERS,
        },
        ..ProgramStart::NONE
    };
}

/// The constant properties of a device.
#[derive(Clone, Copy, Debug)]
pub struct Setup {
    /// The bootloader.
    pub config: &'static bootloader::Config,
    /// The object dictionary of the stand-in; `None` for a silent program.
    pub stand_in: Option<&'static [Entry]>,
    /// The stand-in refuses each command to leave.
    pub refuses: bool,
    /// 1018h/4.
    pub serial_number: u32,
    /// Node-ID and bit rate until other values are stored.
    pub node: NodeParameters,
    /// The entry strap is set: the device stays in the bootloader, also with a program.
    pub strap: bool,
}

/// The result of a reset, or an event of the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The bootloader runs.
    Bootloader {
        /// The active node-ID; `None` while the device waits for one.
        node: Option<NodeId>,
        /// The reason.
        reason: Reason,
    },
    /// A program would run.
    Program {
        /// Its number.
        number: u8,
        /// It is started once, without a release.
        trial: bool,
        /// Its node-ID.
        node: Option<NodeId>,
    },
    /// The process of a program has ended.
    Ended {
        /// The number of the program.
        number: u8,
        /// How.
        ending: Ending,
    },
    /// The running program or bootloader has a new node-ID from layer setting services.
    NodeId(NodeId),
}

/// A device with `PROGRAMS` programs.
pub struct Device<'b, const PROGRAMS: usize> {
    setup: Setup,
    /// What is started as its programs.
    command: Option<&'b Command>,
    phase: Phase<'b, PROGRAMS>,
}

/// What runs between two resets.
enum Phase<'b, const PROGRAMS: usize> {
    Bootloader(Box<Running<Bootloader<'b, FileFlash, Journal, PROGRAMS, Ours<PROGRAMS>>>>),
    StandIn(Box<Running<StandIn>>, &'b mut [u8], Option<Hosted>),
    Silent(Idle<'b>),
    /// Only during the change from one to the other.
    None,
}

/// A program that runs as a process of the host.
struct Hosted {
    number: u8,
    process: Process,
    /// The stand-in leaves with this request; the process is being ended.
    leaving: Option<BootRequest>,
}

/// The parts that the next bootloader needs.
struct Idle<'b> {
    flash: FileFlash,
    buffer: &'b mut [u8],
}

/// A program or a bootloader on the bus.
struct Running<D> {
    device: D,
    slave: Slave,
    /// The node-ID that was reported last.
    reported: Option<NodeId>,
    /// The reset that ends the bootloader.
    pending_reset: Option<PendingReset>,
    /// A request to the program that the bootloader must answer.
    owed: Option<Frame>,
}

/// A reset that is due.
#[derive(Clone, Copy)]
struct PendingReset {
    request: Option<BootRequest>,
    /// Its time; set after the answer is on the bus.
    at: Option<Instant>,
}

impl<'b, const PROGRAMS: usize> Device<'b, PROGRAMS> {
    /// Switches a device on.
    #[must_use]
    pub fn new(setup: Setup, flash: FileFlash, buffer: &'b mut [u8]) -> (Self, Event) {
        Self::hosted(setup, None, flash, buffer)
    }

    /// Switches a device on whose programs are started by this command; the setup has a stand-in.
    #[must_use]
    pub fn hosted(
        setup: Setup,
        command: Option<&'b Command>,
        flash: FileFlash,
        buffer: &'b mut [u8],
    ) -> (Self, Event) {
        let mut device = Self { setup, command, phase: Phase::None };
        let event = device.reset(Idle { flash, buffer }, ResetCause::PowerOn, None);
        (device, event)
    }

    /// Its flash.
    pub fn flash(&mut self) -> Option<&mut FileFlash> {
        match &mut self.phase {
            Phase::Bootloader(running) => Some(running.device.flash()),
            Phase::StandIn(running, ..) => Some(running.device.flash()),
            Phase::Silent(idle) => Some(&mut idle.flash),
            Phase::None => None,
        }
    }

    /// Processes any frame of the bus.
    pub fn handle(&mut self, frame: &Frame, now: Instant) {
        match &mut self.phase {
            Phase::Bootloader(running) => running.handle(frame, now),
            // A device that is about to reset accepts nothing.
            Phase::StandIn(_, _, Some(Hosted { leaving: Some(_), .. })) => {}
            Phase::StandIn(running, ..) => running.handle_in_program(frame, now),
            Phase::Silent(_) | Phase::None => {}
        }
    }

    /// Continues all work: one bounded step on the flash, frames to send, a reset. Returns whether
    /// there is more to do at once.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn work(
        &mut self,
        now: Instant,
        send: &mut impl FnMut(Frame),
        report: &mut impl FnMut(Event),
    ) -> io::Result<bool> {
        let reset;
        let mut more = false;
        match &mut self.phase {
            Phase::Bootloader(running) => {
                running.device.set_time(now);
                more = running.device.step() == Step::Again;
                // Finished work is in the file before it is reported.
                let finished = !running.device.busy();
                let flash = running.device.flash();
                if finished && flash.is_urgent() || flash.unsaved().is_some_and(|since| since >= SAVE_AFTER) {
                    flash.save()?;
                }
                if let Some(request) = running.device.take_boot_request() {
                    running.pending_reset = Some(PendingReset { request: Some(request), at: None });
                }
                let finishing = running.device.is_finishing();
                reset = running.exchange(now, !finishing, send);
                running.report_node_id(report);
            }
            Phase::StandIn(running, _, hosted) => {
                let flash = running.device.flash();
                if flash.is_urgent() {
                    flash.save()?;
                }
                reset = match hosted {
                    None => running.leave_or_exchange(now, send).map(Some),
                    Some(hosted) => {
                        hosted.leaving = hosted.leaving.or_else(|| running.leave_or_exchange(now, send));
                        let ending = hosted.process.poll(hosted.leaving.is_some());
                        if let Some(ending) = ending {
                            report(Event::Ended { number: hosted.number, ending });
                        }
                        // A process that ends by itself leaves no request: a crash.
                        ending.map(|_| hosted.leaving)
                    }
                };
                running.report_node_id(report);
            }
            Phase::Silent(_) | Phase::None => return Ok(false),
        }
        if let Some(request) = reset {
            let idle = match std::mem::replace(&mut self.phase, Phase::None) {
                Phase::Bootloader(running) => {
                    let (flash, buffer) = running.device.into_parts();
                    Idle { flash, buffer }
                }
                Phase::StandIn(running, buffer, _) => Idle { flash: running.device.into_flash(), buffer },
                Phase::Silent(idle) => idle,
                Phase::None => return Ok(false),
            };
            report(self.reset(idle, ResetCause::Software, request));
            more = true;
        }
        Ok(more)
    }

    /// The boot stage: selects bootloader or program.
    fn reset(&mut self, idle: Idle<'b>, cause: ResetCause, request: Option<BootRequest>) -> Event {
        let Setup { config, stand_in, refuses, serial_number, node, strap } = self.setup;
        let Idle { mut flash, buffer } = idle;
        let mut journal = Journal::open(&flash, config.layout.parameters);
        let node = NodeParameters::load(&journal, &flash, node, supports);
        // Its stand-ins may erase, since no core stalls: a journal that is nearly full holds no program back.
        if journal.is_nearly_full() && journal.compact(0) {
            let _ = run(&mut flash, |flash, outcome| journal.next(flash, outcome));
        }
        // A program that is data does not start.
        let numbers = if config.download.data == Some(2) { &PROGRAM_NUMBERS[..1] } else { &PROGRAM_NUMBERS };
        let policy = Policy { crc: config.download.crc, ..Policy::plain(config.layout, numbers) };
        let woken = Woken { cause, request, strap, ..Woken::power_on(node.id_or_none(), node.bit_rate) };
        let choice = choose(&woken, &Images::SOUND, &flash, &journal, &policy);
        if let Some(Store::CrashCount(count)) = choice.store {
            journal.store(Key::CRASH_COUNT, [count, 0, 0, 0]);
            // As on the chip, the start continues if that fails.
            let _ = run(&mut flash, |flash, outcome| journal.next(flash, outcome));
        }
        match choice.exit {
            Exit::Again | Exit::Choose => unreachable!("its bootloader is whole, and it is not sealed"),
            Exit::Bootloader { stay, crash_resets, renewal, .. } => {
                let (reason, report) = (stay.reason, woken.report(stay, crash_resets, renewal));
                let device = Bootloader::new(
                    config,
                    serial_number,
                    node,
                    &report,
                    journal,
                    flash,
                    buffer,
                    Sealed::NONE,
                );
                let address = device.lss_address();
                let node = NodeParameters { id: device.node_id(), ..node };
                let slave = slave(address, node, config.device.heartbeat_ms, NmtPolicy::StayPreOperational);
                let mut running = Running::new(device, slave, node.id);
                running.owed = match request {
                    Some(BootRequest::Owed(owed)) => asked(owed),
                    _ => None,
                };
                self.phase = Phase::Bootloader(Box::new(running));
                Event::Bootloader { node: node.id, reason }
            }
            Exit::Program(decision::Start { number, trial, .. }) => {
                self.phase = match stand_in {
                    None => Phase::Silent(Idle { flash, buffer }),
                    Some(entries) => {
                        let identity = boot_core::canopen::device::Device { serial_number, ..config.device };
                        let defaults = Defaults {
                            node_id: node.id.map(NodeId::get),
                            bit_rate: node.bit_rate.or_zero(),
                            serial_number,
                        };
                        let start = Start {
                            program: number,
                            fresh: matches!(request, Some(BootRequest::Fresh(_))),
                            ..Start::new(None, defaults)
                        };
                        let hosted = self.command.map(|command| {
                            let place = Place { serial_number, node_id: node.id_or_none(), program: number };
                            let program = contents(&flash, &journal, config, number);
                            let file = flash.path().with_extension(format!("program{number}"));
                            let process = Process::start(command, &file, &program, place);
                            Hosted { number, process, leaving: None }
                        });
                        // A lift's bootloader is another node.
                        let hands_over = config.node_id.is_none();
                        let mut device =
                            StandIn::new(entries, identity, &start, hands_over, flash, config.layout);
                        device.refuses = refuses;
                        let heartbeat = config.device.heartbeat_ms;
                        let slave = slave(device.lss_address(), node, heartbeat, NmtPolicy::Follow);
                        Phase::StandIn(Box::new(Running::new(device, slave, node.id)), buffer, hosted)
                    }
                };
                Event::Program { number, trial, node: node.id }
            }
        }
    }
}

/// The bytes of a program, as they were downloaded.
fn contents(flash: &FileFlash, journal: &Journal, config: &bootloader::Config, number: u8) -> Vec<u8> {
    let record = journal.program(flash, number);
    let (Some(record), Some(region)) = (record, config.layout.program(number)) else { return Vec::new() };
    let mut bytes = vec![0; record.size.min(region.size) as usize];
    flash.read(region.base, &mut bytes);
    bytes
}

/// The request to the program, which the bootloader carries out after its boot-up message.
fn asked(owed: Owed) -> Option<Frame> {
    let Owed { program, value, node_id } = owed;
    let request = [0x2F, 0x51, 0x1F, program, value, 0, 0, 0];
    Some(Frame::full(CobId::sdo_request(NodeId::new(node_id)?), request))
}

fn slave(
    address: boot_core::canopen::lss::LssAddress,
    node: NodeParameters,
    heartbeat_ms: u16,
    nmt: NmtPolicy,
) -> Slave {
    let config = slave::Config {
        node: node::Config { heartbeat_ms, nmt, ..node::Config::default() },
        ..slave::Config::default()
    };
    Slave::new(address, node.id, node.bit_rate, config)
}

impl<D: SlaveDevice> Running<D> {
    fn new(device: D, slave: Slave, reported: Option<NodeId>) -> Self {
        Self { device, slave, reported, pending_reset: None, owed: None }
    }

    fn handle(&mut self, frame: &Frame, now: Instant) {
        // A device that is about to reset accepts nothing.
        if self.pending_reset.is_some_and(|pending_reset| pending_reset.at.is_some()) {
            return;
        }
        if self.slave.handle(frame, now, &mut self.device) {
            self.pending_reset = Some(PendingReset { request: None, at: None });
        }
    }

    /// Reports a node-ID that was set over the bus.
    fn report_node_id(&mut self, report: &mut impl FnMut(Event)) {
        let id = self.slave.node().map(Node::id);
        if let Some(id) = id.filter(|_| id != self.reported) {
            self.reported = Some(id);
            report(Event::NodeId(id));
        }
    }

    /// Sends the waiting frames. Returns the request for the reset, when it is due.
    fn exchange(
        &mut self,
        now: Instant,
        may_reset: bool,
        send: &mut impl FnMut(Frame),
    ) -> Option<Option<BootRequest>> {
        if let Some(PendingReset { request, at: Some(at) }) = self.pending_reset {
            return now.has_reached(at).then_some(request);
        }
        self.send(now, send);
        if let Some(asked) = self.owed.take() {
            // After the boot-up message.
            self.handle(&asked, now);
            self.send(now, send);
        }
        if let Some(pending_reset) = self.pending_reset.as_mut().filter(|_| may_reset && self.slave.is_idle())
        {
            pending_reset.at = Some(now + ANSWER_TO_RESET_MS);
        }
        None
    }

    fn send(&mut self, now: Instant, send: &mut impl FnMut(Frame)) {
        while let Some(output) = self.slave.poll(now, true, &mut self.device) {
            match output {
                Output::Send(frame) => send(frame),
                // The bus has no bit rate, no filters and no bus-off.
                Output::Join(_) | Output::Listen(_) | Output::RecoverFromBusOff | Output::Accept(_) => {}
            }
        }
    }
}

/// A program that leaves like the application template.
impl Running<StandIn> {
    fn handle_in_program(&mut self, frame: &Frame, now: Instant) {
        if self.device.control.proceed(false, now.as_millis()) != Next::Serve {
            return;
        }
        self.device.set_time(now);
        if self.slave.handle(frame, now, &mut self.device) {
            self.device.control.nmt_reset(now.as_millis());
        }
    }

    /// Leaves with this request if it is time; otherwise sends the waiting frames.
    fn leave_or_exchange(&mut self, now: Instant, send: &mut impl FnMut(Frame)) -> Option<BootRequest> {
        let quiet = self.slave.is_idle();
        match self.device.control.proceed(quiet, now.as_millis()) {
            Next::Leave(request) => return Some(request),
            Next::Wait => {}
            Next::Serve => self.send(now, send),
        }
        None
    }
}
