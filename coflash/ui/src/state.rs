//! The state that all pages show. Each change is sent to every page.

use std::collections::BTreeMap;

use canopen::program::ProgramState;
use canopen::NodeId;
use serde::{Serialize, Serializer};
use serde_json::json;
use shared_abi::layout::Layout;

use super::advice;
use coboot_can::decode::state_words;
use coflash_core::device::access::Security;
use coflash_core::device::info::{DeviceInfo, ProgramInfo};
use coflash_core::device::lss::LssAddress;
use coflash_core::device::scan::Found;
use coflash_core::device::state::supply;
use coflash_core::device::Error;
use coflash_core::machine::EVERY_VERSION_HAS_THIS_CRC;
use coflash_core::update::many::Failed;
use coflash_core::update::{self, DeviceState, Event, Installed, Marks};

/// The most reports; the oldest are dropped first.
const REPORTS: usize = 500;
/// The most lines of one device's update.
const LINES: usize = 60;

/// The complete state in the form for the page.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct State {
    pub(super) adapter: Adapter,
    /// `None` until the bus was scanned.
    pub(super) devices: Option<BTreeMap<u8, Device>>,
    pub(super) settings: Settings,
    pub(super) firmware: Option<Firmware>,
    /// The running task; only one runs at a time.
    pub(super) task: Option<Task>,
    /// The devices of the running update, or of the last one.
    pub(super) updates: Vec<Update>,
    /// The result of the last task, or of the last attempt to open the adapter.
    pub(super) notice: Option<Notice>,
    /// The number of notices: distinguishes a new notice with the same text.
    pub(super) notices: u64,
    /// The device found by fastscan.
    #[serde(serialize_with = "address")]
    pub(super) lss: Option<LssAddress>,
    pub(super) readback: Option<Readback>,
    /// What is known of devices whose last update has failed: by node-ID, with 1018h/4.
    #[serde(skip)]
    known: BTreeMap<u8, (Option<u32>, DeviceState)>,
    pub(super) reports: Vec<Report>,
}

/// The access to the bus.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Adapter {
    pub(super) url: String,
    pub(super) state: Connection,
    /// Why it is lost.
    pub(super) words: Option<String>,
    /// A gateway shows no frames.
    pub(super) gateway: bool,
    /// In bit/s, if the URL contains it.
    pub(super) bit_rate: Option<u32>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Connection {
    #[default]
    Closed,
    Opening,
    Open,
    /// It was open, and the worker tries to open it again.
    Lost,
}

/// The settings for reading files, and the program number.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Settings {
    /// The board that gives the region of a program: built in, or from a file of the user.
    #[serde(serialize_with = "name")]
    pub(super) board: Option<&'static Layout>,
    /// Sub-index of 1F50h.
    pub(super) program: u8,
}

fn name<S: Serializer>(board: &Option<&'static Layout>, to: S) -> Result<S::Ok, S::Error> {
    board.map(|board| board.board).serialize(to)
}

fn address<S: Serializer>(address: &Option<LssAddress>, to: S) -> Result<S::Ok, S::Error> {
    let parts = |LssAddress { vendor_id, product_code, revision, serial_number }: LssAddress| {
        json!({
            "vendor_id": vendor_id, "product_code": product_code, "revision": revision,
            "serial_number": serial_number,
        })
    };
    address.map(parts).serialize(to)
}

impl Default for Settings {
    fn default() -> Self {
        Self { board: None, program: 1 }
    }
}

/// A node that answered or was heard.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Device {
    pub(super) node: u8,
    pub(super) answers: bool,
    /// Whether the bootloader runs.
    pub(super) bootloader: bool,
    /// The words for what runs.
    pub(super) runs: String,
    pub(super) name: Option<String>,
    pub(super) hardware: Option<String>,
    pub(super) software: Option<String>,
    /// 1018h/1 to 4.
    pub(super) identity: [Option<u32>; 4],
    /// NMT state of the last heartbeat.
    pub(super) heartbeat: Option<&'static str>,
    pub(super) dialect: Option<&'static str>,
    /// What it reports about sealed images: whether it is sealed, root keys, counters and epoch.
    pub(super) security: Option<Security>,
    /// Why it stays in its bootloader now, and why it did at its last reset, in words (2007h); what to do.
    pub(super) state: Option<String>,
    pub(super) last_reset: Option<String>,
    pub(super) advice: Option<String>,
    /// Its supply, in words (2007h).
    pub(super) supply: Option<&'static str>,
    /// Its option bytes in words, and what is wrong with them.
    pub(super) option_bytes: Option<String>,
    pub(super) warnings: Vec<&'static str>,
    /// Its bootloader, in words, if that can be renewed.
    pub(super) renewable: Option<String>,
    pub(super) programs: Vec<Program>,
    /// The comparison of the firmware file's label with this device.
    pub(super) verdict: Option<Verdict>,
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct Program {
    pub(super) number: u8,
    pub(super) crc: Option<u32>,
    /// The state (none, stopped or running) and the flash status.
    pub(super) words: String,
    /// What the device reports of it.
    #[serde(skip)]
    info: ProgramInfo,
}

/// The comparison of a file with a device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Verdict {
    pub(super) fits: Fits,
    pub(super) words: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Fits {
    Yes,
    No,
    /// File or device does not give its identity.
    Unknown,
}

/// The chosen firmware file.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Firmware {
    pub(super) name: String,
    pub(super) size: usize,
    /// The output of `inspect`.
    pub(super) inspection: String,
    /// Bytes of the program in flash.
    pub(super) program_size: u32,
    pub(super) crc: u32,
    /// What a device reports that has it.
    #[serde(skip)]
    pub(super) marks: Marks,
    pub(super) vendor_id: Option<u32>,
    pub(super) product_code: Option<u32>,
    pub(super) version: Option<String>,
    /// Bytes that the conversion left out.
    pub(super) left_out: u64,
    /// Whether it is a bootloader, which takes the place of that of the device.
    pub(super) is_bootloader: bool,
    /// Further properties of a sealed image.
    pub(super) seal: Option<Seal>,
}

/// The properties of a sealed image from its manifest; the device checks whether they are valid.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Seal {
    /// The program's number on the board.
    pub(super) program: u8,
    /// The security counter.
    pub(super) counter: u32,
    /// The ids of the keys that have signed it.
    pub(super) signed_by: Vec<u32>,
    /// The ids of the key-encryption keys that decrypt it; empty if it is not encrypted.
    pub(super) opened_by: Vec<u32>,
    /// Its flags in words.
    pub(super) flags: Vec<&'static str>,
}

/// The running task.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Task {
    pub(super) kind: &'static str,
    pub(super) words: String,
    pub(super) cancelling: bool,
    /// In percent, if it is known.
    pub(super) percent: Option<u32>,
}

/// The update of one device.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Update {
    pub(super) node: u8,
    pub(super) phase: Phase,
    pub(super) done: usize,
    pub(super) total: usize,
    /// The last event.
    pub(super) words: String,
    pub(super) advice: Option<String>,
    pub(super) lines: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Phase {
    Waiting,
    Running,
    Done,
    Failed,
}

/// The result of a task.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Notice {
    pub(super) ok: bool,
    pub(super) words: String,
    /// What to do next.
    pub(super) advice: Option<String>,
}

/// A program that was read from a device.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Readback {
    pub(super) node: u8,
    pub(super) program: u8,
    pub(super) size: usize,
}

/// The result of an update of one device, for printing.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Report {
    pub(super) number: u64,
    /// The number of the run; the devices of one update have the same number.
    pub(super) run: u64,
    /// Seconds since 1970, UTC.
    pub(super) date: u64,
    pub(super) node: u8,
    pub(super) ok: bool,
    pub(super) words: String,
    pub(super) device: Option<String>,
    pub(super) serial_number: Option<u32>,
    pub(super) file: String,
    /// The CRC of the program in the device, as the device reports it.
    pub(super) crc: Option<u32>,
    /// The CRC of the program in the file.
    pub(super) file_crc: u32,
    /// The value of 100Ah after the update.
    pub(super) version: Option<String>,
    /// The file's software version.
    pub(super) file_version: Option<String>,
    pub(super) seconds: f64,
    pub(super) adapter: String,
    pub(super) tool: String,
}

impl State {
    /// Replaces the known devices by the result of a scan.
    pub(super) fn found(&mut self, found: &BTreeMap<NodeId, Found>) {
        let devices = found.iter().map(|(node, found)| {
            let device = match &found.info {
                Some(info) => Device::of(info),
                None => {
                    let no_answer = || "no answer by SDO".to_string();
                    let runs = found.but.as_ref().map_or_else(no_answer, |but| format!("answers, but {but}"));
                    Device { node: node.get(), runs, ..Device::default() }
                }
            };
            (node.get(), Device { heartbeat: found.state.map(state_words), ..device })
        });
        self.devices = Some(devices.collect());
        self.judge();
    }

    /// Updates one device.
    pub(super) fn update_device(&mut self, info: &DeviceInfo) {
        let devices = self.devices.get_or_insert_default();
        let heartbeat = devices.get(&info.node.get()).and_then(|device| device.heartbeat);
        devices.insert(info.node.get(), Device { heartbeat, ..Device::of(info) });
        self.judge();
    }

    /// Marks a device that no longer answers, or has a new node-ID.
    pub(super) fn silent(&mut self, node: NodeId) {
        if let Some(device) = self.devices.as_mut().and_then(|devices| devices.get_mut(&node.get())) {
            device.answers = false;
            device.runs = "no answer by SDO".to_string();
        }
    }

    /// Compares the file with each device.
    pub(super) fn judge(&mut self) {
        let number = self.settings.program;
        for device in self.devices.iter_mut().flat_map(BTreeMap::values_mut) {
            device.verdict = self.firmware.as_ref().map(|file| file.against(device, number));
            if device.answers && !device.bootloader {
                self.known.remove(&device.node);
            }
        }
    }

    /// Enters what is known of devices into the results that changed nothing, and remembers the others.
    pub(super) fn recall(&mut self, nodes: &[NodeId], results: &mut [Result<update::Report, Failed>]) {
        for (node, result) in nodes.iter().map(|node| node.get()).zip(results) {
            match result {
                Err(Failed { left, .. }) => *left = left.after(self.left(node, left.state)),
                Ok(_) => drop(self.known.remove(&node)),
            }
        }
    }

    /// The state of a device after a failed update: if it changed nothing, that of the one before.
    fn left(&mut self, node: u8, left: DeviceState) -> DeviceState {
        let serial = self.devices.as_ref().and_then(|devices| devices.get(&node)?.identity[3]);
        if left != DeviceState::Untouched {
            self.known.insert(node, (serial, left));
            return left;
        }
        // Another device may be there since then.
        let known = self.known.get(&node).filter(|(known, _)| may_be_of(*known, serial));
        known.map_or(left, |(_, state)| *state)
    }

    /// Enters a task as the running one.
    pub(super) fn begin(&mut self, kind: &'static str, words: String) {
        self.notice = None;
        self.task = Some(Task { kind, words, cancelling: false, percent: None });
    }

    pub(super) fn notice(&mut self, notice: Notice) {
        self.notices += 1;
        self.notice = Some(notice);
    }

    pub(super) fn report(&mut self, report: Report) {
        if self.reports.len() >= REPORTS {
            self.reports.remove(0);
        }
        self.reports.push(report);
    }
}

impl Device {
    fn of(info: &DeviceInfo) -> Self {
        let option_bytes = info.state.and_then(|state| state.option_bytes);
        Self {
            node: info.node.get(),
            answers: true,
            bootloader: info.device_type.is_bootloader(),
            runs: if info.device_type.is_bootloader() { "bootloader" } else { "application" }.to_string(),
            name: info.name.clone(),
            hardware: info.hardware_version.clone(),
            software: info.software_version.clone(),
            identity: info.identity,
            heartbeat: None,
            dialect: info.dialect.map(|dialect| dialect.name()),
            security: info.security.clone(),
            state: info.state.map(|state| state.to_string()),
            last_reset: info.state.and_then(|state| state.last_reset()),
            advice: info.advice().map(|advice| advice::on_page(&advice)),
            supply: info.state.and_then(|state| supply(state.supply)),
            option_bytes: option_bytes.map(|bytes| bytes.to_string()),
            warnings: option_bytes.map_or(Vec::new(), |bytes| bytes.warnings()),
            renewable: info.bootloader.map(|bootloader| advice::with_advice(bootloader, bootloader.advice())),
            programs: info.programs.iter().map(Program::of).collect(),
            verdict: None,
        }
    }

    /// The values of 1018h/1 and 1018h/2, if they are not 0.
    pub(super) fn product(&self) -> Option<(u32, u32)> {
        match (self.identity[0], self.identity[1]) {
            (Some(vendor), Some(product)) if vendor != 0 || product != 0 => Some((vendor, product)),
            _ => None,
        }
    }

    /// One of its programs.
    pub(super) fn program(&self, number: u8) -> Option<&Program> {
        self.programs.iter().find(|program| program.number == number)
    }
}

impl Program {
    fn of(info: &ProgramInfo) -> Self {
        const STOPPED: u32 = ProgramState::Stopped as u32;
        const RUNNING: u32 = ProgramState::Running as u32;
        const ABSENT: u32 = ProgramState::Absent as u32;
        let mut words = match info.control {
            // 1F56h reads 0 if there is no program.
            Some(STOPPED) if info.crc == Some(0) => "none".to_string(),
            Some(STOPPED) => "stopped".to_string(),
            Some(RUNNING) => "running".to_string(),
            Some(ABSENT) => "none".to_string(),
            Some(other) => format!("state {other:02X}h"),
            None => "not reported".to_string(),
        };
        match info.status {
            Some(status) if status.busy => words += ", busy",
            Some(status) => {
                if let Some(error) = status.error {
                    words += &format!(", {error} ({:02X}h)", error.code());
                }
            }
            None => {}
        }
        if let Some(version) = info.release() {
            words += &format!(", {version}");
        }
        if let Some(released) = info.released {
            words += if released { ", released" } else { ", not released" };
        }
        Self { number: info.number, crc: info.crc, words, info: *info }
    }
}

impl Firmware {
    /// Compares the file with a device.
    fn against(&self, device: &Device, number: u8) -> Verdict {
        let verdict = |fits, words: String| Verdict { fits, words };
        let target = match (self.vendor_id, self.product_code) {
            (Some(vendor), Some(product)) if vendor != 0 || product != 0 => Some((vendor, product)),
            _ => None,
        };
        let has = device.program(number).filter(|_| !self.is_bootloader);
        let has = has.map_or(Installed::Other, |program| self.marks.compare(&program.info));
        match (target, device.product()) {
            (Some((file, _)), Some((own, _))) if file != own => {
                verdict(Fits::No, format!("made for vendor-ID {file:08X}h, this device has {own:08X}h"))
            }
            (Some((_, file)), Some((_, own))) if file != own => {
                verdict(Fits::No, format!("made for product code {file:08X}h, this device has {own:08X}h"))
            }
            (Some(_), Some(_)) if self.is_bootloader => match &device.renewable {
                Some(_) => verdict(Fits::Yes, "a bootloader for this product".to_string()),
                None => verdict(Fits::Unknown, "the device does not report its bootloader".to_string()),
            },
            _ if has == Installed::This => verdict(Fits::Yes, "in the device already".to_string()),
            _ if has == Installed::Unknown => verdict(Fits::Unknown, EVERY_VERSION_HAS_THIS_CRC.to_string()),
            (Some(_), Some(_)) => verdict(Fits::Yes, "made for this product".to_string()),
            (None, _) => verdict(Fits::Unknown, "the file does not name its target device".to_string()),
            (_, None) => verdict(Fits::Unknown, "the device does not report its product".to_string()),
        }
    }
}

impl Update {
    pub(super) fn waiting(node: NodeId) -> Self {
        Self {
            node: node.get(),
            phase: Phase::Waiting,
            done: 0,
            total: 0,
            words: "waiting for its turn".to_string(),
            advice: None,
            lines: Vec::new(),
        }
    }

    /// Records an event.
    pub(super) fn event(&mut self, event: &Event) {
        self.phase = Phase::Running;
        if let Event::Progress { done, total } = *event {
            (self.done, self.total) = (done, total);
            self.words = "sending the program".to_string();
            return;
        }
        // The result reports it, together with the state of the device.
        if let Event::Done(_) = event {
            return;
        }
        self.words = advice::with_advice(event, event.advice());
        if self.lines.len() < LINES {
            self.lines.push(self.words.clone());
        }
    }

    pub(super) fn failed(&mut self, error: &Error, left: &str) {
        self.phase = Phase::Failed;
        self.words = format!("{error}. The device: {left}.");
        self.advice = Some(advice::on_page(&error.advice()));
    }
}

impl Notice {
    pub(super) fn done(words: impl Into<String>) -> Self {
        Self { ok: true, words: words.into(), advice: None }
    }

    pub(super) fn failed(words: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { ok: false, words: words.into(), advice: Some(advice.into()) }
    }

    pub(super) fn error(error: &Error) -> Self {
        Self::failed(error.to_string(), advice::on_page(&error.advice()))
    }
}

/// Whether what is known of a device with this serial number (1018h/4) may be of the one that is there now. A
/// device may not answer, or its application may not have the object.
pub(super) fn may_be_of(known: Option<u32>, now: Option<u32>) -> bool {
    known.is_none() || now.is_none() || known == now
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use coflash_core::device::scan::{scan, ScanOptions};
    use kit::fake::{Bus, Fake, Maker, APPLICATION};

    use super::*;

    /// Vendor-ID, product code, and 2005h.
    struct Version(u32);

    impl Maker for Version {
        fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
            let value = match at {
                (0x1018, 1 | 2) => 0,
                (0x2005, 1) => self.0,
                _ => return None,
            };
            Some(Ok(value.to_le_bytes().to_vec()))
        }
    }

    /// The same CRC with another version is another program; the file is V1.10r100 (expected.py).
    #[test]
    fn a_crc_alone_does_not_say_that_a_device_has_the_program() {
        let bytes = include_bytes!("../../core/tests/data/release-110.blk").to_vec();
        let load = crate::firmware::load(bytes.into(), "a.blk", &Settings::default());
        let file = load.unwrap_or_else(|notice| panic!("{}", notice.words)).shown;
        for (version, is_there) in [(0x0064_0A01, true), (0, true), (0x0065_0A01, false)] {
            let mut fake = Fake::new(APPLICATION);
            fake.crc_of_application = Some(file.crc);
            fake.maker = Some(Box::new(Version(version)));
            let found = scan(&mut Bus(vec![fake]), &ScanOptions::default(), &Arc::default()).unwrap();
            let info = found.values().find_map(|found| found.info.as_ref()).unwrap();
            let words = file.against(&Device::of(info), 1).words;
            assert_eq!(words.contains("already"), is_there, "{version:08X}h: {words}");
        }
    }

    /// Another device at the node has lost nothing; one without an answer may be that of before.
    #[test]
    fn what_is_known_of_a_device_is_not_known_of_another_one() {
        let mut state = State::default();
        let mut after = |serial, left| {
            let identity = [None, None, None, serial];
            state.devices = Some([(5, Device { identity, ..Device::default() })].into());
            state.left(5, left)
        };
        let (erased, untouched) = (DeviceState::Erased, DeviceState::Untouched);
        assert_eq!(after(Some(1), erased), erased);
        let later = [Some(1), Some(2), None].map(|serial| after(serial, untouched));
        assert_eq!(later, [erased, untouched, erased]);
        // Nor had it one at first.
        assert_eq!(
            [None, Some(1)].map(|serial| [after(serial, erased), after(Some(1), untouched)]),
            [[erased; 2]; 2]
        );
    }
}
