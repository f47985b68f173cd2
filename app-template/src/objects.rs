//! The values of the application's object dictionary. The values of 1F51h, 1F56h and 1F57h come
//! from `coboot-app`, which also decides when the device goes back to its bootloader; those of the
//! process from `process.rs`.

use core::sync::atomic::Ordering::SeqCst;
use core::task::Poll;

use bsp::{line, IDENTITY, LAYOUT, NODE_ID};
use canopen::device::Device;
use canopen::emcy::{register, Emcy};
use canopen::line::LineEvent;
use canopen::lss::{LssDevice, StoreError};
use canopen::nmt::NmtState;
use canopen::node::{self, NmtPolicy};
use canopen::od::{put, Address, Entry, Exchange, Objects, Reply};
use canopen::pdo::Pdos;
use canopen::program::{Numbers, PROGRAM_CONTROL};
use canopen::sdo::server::Config as SdoConfig;
use canopen::slave::{self, Slave, SlaveDevice};
use canopen::{AbortCode, BitRate, CobId, Frame, Instant, NodeId};
use coboot_app::nameplate::Nameplate;
use coboot_app::rules::Command;
use coboot_app::warm_start::BootRequest;
use coboot_app::{Bootloader, Defaults, Next, ProgramControl, Start};

use crate::entries::{entries, entry_count, numbers, COMMAND, PDOS};
use crate::process::{may_leave, Process, LEAVES, MACHINE, OWN};

/// 1000h: no standardised profile. Anything but the bootloader's 10000000h shows a host that the
/// application runs.
const DEVICE_TYPE: u32 = 0;
/// 1017h, in ms.
pub const HEARTBEAT_MS: u16 = 500;
/// The bit rate that the program uses when no bootloader has started it.
const DEFAULT_BIT_RATE: BitRate = match BitRate::from_bits_per_second(bsp::BIT_RATE) {
    Some(rate) => rate,
    None => panic!("board: the bit rate must be one of CANopen's, or 0 to find it out"),
};
/// 1018h/1 to 3, from the board file.
const BOARD: Nameplate = Nameplate::new(IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision, 0);
/// 80h to 1F51h: a master calls the bootloader (SYS TEC manual L-1112d_10, table 2).
const START_BOOTLOADER: u8 = Command::StartBootloader as u8;

/// Programs of the device and the bootloader, each a sub-index of 1F51h, 1F56h and 1F57h.
const NUMBERS: Numbers = numbers(LAYOUT);
/// The object dictionary.
static ENTRIES: [Entry; entry_count(NUMBERS)] = entries(NUMBERS).entries();

/// The bootloader underneath.
const BOOTLOADER: Bootloader = Bootloader::new(LAYOUT);

/// The application's state that is visible on the bus.
pub struct Application {
    device: Device,
    /// 1F51h, 1F56h, 1F57h, and the way back.
    pub control: ProgramControl,
    bootloader: Bootloader,
    /// The time of the last call of [`Self::set_time`].
    now: Instant,
    emcy: Emcy,
    pdos: Pdos<{ PDOS.len() }>,
    process: Process,
    /// Node-ID in force.
    id: Option<NodeId>,
    /// Bit rate that the device came up with.
    bit_rate: BitRate,
}

impl Application {
    /// The application, and its slave, with what the bootloader has left: node-ID, bit rate and the
    /// COB-IDs of SDO, so that a client of the bootloader goes on with the application. Asks the
    /// bootloader for the CRC over this program, once. `software_version` is 100Ah.
    pub fn start(software_version: &'static str) -> (Self, Slave) {
        let defaults = Defaults {
            node_id: NodeId::new(NODE_ID).map(NodeId::get),
            bit_rate: bsp::BIT_RATE,
            serial_number: bsp::serial_number(),
        };
        let start = Start::read(LAYOUT, defaults);
        let application = Self::new(&start, software_version);
        let sdo = SdoConfig {
            request_base: start.sdo().request,
            response_base: start.sdo().response,
            ..SdoConfig::DEFAULT
        };
        let node = node::Config {
            heartbeat_ms: HEARTBEAT_MS,
            nmt: NmtPolicy::Follow,
            sdo,
            ..node::Config::default()
        };
        let config = slave::Config { node, ..slave::Config::default() };
        let address = application.device.lss_address();
        let slave = Slave::new(address, application.id, application.bit_rate, config);
        (application, slave)
    }

    fn new(start: &Start, software_version: &'static str) -> Self {
        // A bootloader that has another identity from the nameplate of the device shows that one.
        let Nameplate { vendor_id, product_code, revision, .. } = start.nameplate().unwrap_or(BOARD);
        let device = Device {
            device_type: DEVICE_TYPE,
            name: IDENTITY.device_name,
            hardware_version: IDENTITY.hardware_version,
            software_version,
            heartbeat_ms: HEARTBEAT_MS,
            vendor_id,
            product_code,
            revision,
            serial_number: start.serial_number,
        };
        let crc = BOOTLOADER.program_crc(start.program);
        let control = ProgramControl::new(start, LAYOUT, crc).asking(may_leave);
        Self {
            device,
            control,
            bootloader: BOOTLOADER,
            now: Instant::from_millis(0),
            bit_rate: BitRate::from_bits_per_second(start.bit_rate).unwrap_or(DEFAULT_BIT_RATE),
            emcy: Emcy::new(),
            pdos: Pdos::new(&PDOS, None),
            process: Process,
            id: start.node_id.and_then(NodeId::new),
        }
    }

    /// Passes the time in: call it at least every few milliseconds.
    pub fn set_time(&mut self, now: Instant) {
        self.now = now;
    }

    /// Advances the departure, if one is in progress.
    pub fn proceed(&mut self, bus_idle: bool) -> Next<BootRequest> {
        if self.control.leaving() {
            // An NMT reset did not ask.
            MACHINE.store(LEAVES, SeqCst);
        }
        self.control.proceed(bus_idle, self.now.as_millis())
    }

    /// The callback of 1F51h = 80h, START_BOOTLOADER: a master calls the bootloader in the place of
    /// `program`.
    ///
    /// It runs before the SDO answer is sent, so it only takes a note: [`proceed`](Self::proceed)
    /// lets the device leave when the answer is on the bus. The first 80h to a program that has just
    /// been downloaded and started confirms that program instead (`coboot_app::rules`). Whether the
    /// device may leave at all is asked of [`may_leave`], for this command and every other one.
    fn start_bootloader(&mut self, program: u8, expedited: bool) -> Result<Reply, AbortCode> {
        self.command(program, &[START_BOOTLOADER], expedited)
    }

    /// Every command: STOP and CLEAR are the bootloader's to carry out and to confirm.
    fn command(&mut self, program: u8, value: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        let now = self.now.as_millis();
        Ok(self.control.write(program, value, expedited, now, &mut self.bootloader)?.into())
    }
}

impl Objects for Application {
    fn entries(&self) -> &'static [Entry] {
        &ENTRIES
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if let Some(read) = self.id.and_then(|id| self.emcy.read(id, at, buf)) {
            return read;
        }
        if let Some(read) = self.device.read(at, buf).or_else(|| self.pdos.read(at, buf)) {
            return read;
        }
        if at.index >= COMMAND {
            return self.process.read(at, buf);
        }
        match self.control.read(at.index, at.sub, &mut self.bootloader) {
            Some(value) => put(buf, &value?),
            None => Err(AbortCode::NO_DATA),
        }
    }

    fn write_with_reply(&mut self, at: Address, data: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        match (at.index, data) {
            (PROGRAM_CONTROL, &[START_BOOTLOADER]) => self.start_bootloader(at.sub, expedited),
            (PROGRAM_CONTROL, value) => self.command(at.sub, value, expedited),
            (COMMAND.., _) => self.process.write(at, data).map(|()| Reply::Send),
            _ => {
                let written = self.emcy.write(at, data);
                let written = written.or_else(|| self.pdos.write(at, data, &ENTRIES, &self.process));
                written.unwrap_or(Err(AbortCode::UNSUPPORTED_ACCESS)).map(|()| Reply::Send)
            }
        }
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.emcy.next_message()
    }

    fn exchange(&mut self) -> Option<&mut dyn Exchange> {
        Some(self)
    }
}

impl LssDevice for Application {
    fn supports(&mut self, rate: BitRate) -> bool {
        line::supports(rate)
    }

    /// The bootloader stores the values: its journal lies in flash that this program does not own.
    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        let rate = rate.unwrap_or(self.bit_rate);
        let id = id.map(NodeId::get);
        let stored = self.bootloader.store_node(id, rate.or_zero()).map_err(|_| StoreError::Failed);
        if stored.is_ok() {
            self.control.node_stored(id, rate == self.bit_rate);
        }
        Poll::Ready(stored)
    }
}

impl SlaveDevice for Application {
    fn line_event(&mut self, event: LineEvent) {
        self.emcy.line_event(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.id = id;
        self.pdos = Pdos::new(&PDOS, id);
        self.process.state_changed(NmtState::Initialisation);
        self.control.node_id_changed(id.map(NodeId::get));
    }
}

impl Exchange for Application {
    fn state_changed(&mut self, state: NmtState) {
        self.pdos.state_changed(state);
        self.process.state_changed(state);
    }

    fn handle(&mut self, frame: &Frame) {
        if let Some(code) = self.pdos.handle(frame, &mut self.process) {
            let is_passive = self.emcy.register() & register::COMMUNICATION != 0;
            self.emcy.raise(code, register::COMMUNICATION, [0; 5]);
            if !is_passive {
                // The frame is over.
                self.emcy.clear(register::COMMUNICATION);
            }
        }
        self.process.handle(frame);
    }

    fn poll(&mut self, now: Instant) -> Option<Frame> {
        // The way out must not wait for a bus that is full of PDOs.
        if self.control.leaving() {
            return None;
        }
        self.pdos.poll(now, &mut self.process)
    }

    fn identifier(&self, place: usize) -> Option<CobId> {
        self.pdos.identifiers().chain(OWN).nth(place)
    }

    fn identifiers_changed(&mut self) -> bool {
        self.pdos.identifiers_changed()
    }
}
