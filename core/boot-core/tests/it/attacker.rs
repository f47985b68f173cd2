//! A seeded attacker: random downloads, aborted anywhere, commands, passwords, resets, power cuts
//! and flash faults in any order, on every profile with one and two programs. After every action
//! the rules of [`Rule`] are checked, and at the end each program must be installable as in a new
//! device.
//!
//! The same seed gives the same attack. An attack that breaks a rule is shortened and printed with
//! its actions:
//!
//! ```sh
//! COBOOT_ATTACKS=20000 cargo test --release -p coboot-core attacker::    # seeds per setup
//! COBOOT_ATTACK_SEED=4711 cargo test -p coboot-core attacker::lift_2    # one, with its actions
//! ```

use std::fmt;
use std::task::Poll;

use boot_core::flash::FlashFault;
use boot_core::store::NodeParameters;
use canopen::od::Address;
use canopen::{AbortCode, BitRate, Instant, NodeId};
use kit::model::{caught, Cut, PowerCut};
use kit::random::Random;
use kit::rig::{block, crc32, hex, program, words, Rig, Setup, Stored, PRODUCT_CODE, VENDOR_ID};
use shared_abi::geometry::Region;
use shared_abi::label;
use shared_abi::warm_start::BootRequest;

// --- rules

/// The rules that must hold after any action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rule {
    /// A program with a record has the CRC in 1F56h, and was sent with it.
    RecordIsTrue,
    /// Only the journal and the addressed program are erased or written.
    OnlyTheNamedProgram,
    /// The started program is the requested one, released or on trial as requested.
    StartsWhatWasAsked,
    /// At the end each program can be installed and started.
    CanBeRepaired,
    /// Nothing panics, and all work ends.
    Ends,
    /// The record of a program that was not addressed does not change, nor do the values that LSS
    /// stored.
    OthersStay,
    /// 1F51h, 1F57h and aborts have only documented values.
    DefinedValues,
}

/// A broken rule, with details.
#[derive(Clone, Debug)]
struct Broken(Rule, String);

fn rule(holds: bool, rule: Rule, what: impl FnOnce() -> String) -> Result<(), Broken> {
    if holds {
        Ok(())
    } else {
        Err(Broken(rule, what()))
    }
}

/// Errors in 1F57h (SYS TEC manual L-1112d_10, table 3).
const ERRORS: [u32; 15] =
    [0x00, 0x02, 0x04, 0x06, 0x08, 0x0A, 0x0C, 0x0E, 0x10, 0x7E, 0x80, 0x82, 0x84, 0x86, 0x88];
/// Aborts (CiA 301 table 22).
const ABORTS: [u32; 31] = [
    0x0503_0000,
    0x0504_0000,
    0x0504_0001,
    0x0504_0002,
    0x0504_0003,
    0x0504_0004,
    0x0504_0005,
    0x0601_0000,
    0x0601_0001,
    0x0601_0002,
    0x0602_0000,
    0x0604_0041,
    0x0604_0042,
    0x0604_0043,
    0x0604_0047,
    0x0606_0000,
    0x0607_0010,
    0x0607_0012,
    0x0607_0013,
    0x0609_0011,
    0x0609_0030,
    0x0609_0031,
    0x0609_0032,
    0x0609_0036,
    0x060A_0023,
    0x0800_0000,
    0x0800_0020,
    0x0800_0021,
    0x0800_0022,
    0x0800_0023,
    0x0800_0024,
];

// --- the data that can be sent

/// A program to send.
#[derive(Clone, Copy, Debug)]
struct Image {
    /// The program number for which it is linked.
    place: u8,
    len: usize,
    seed: u8,
}

/// A download of 1F50h.
#[derive(Clone, Copy, Debug)]
enum Sent {
    /// Block 0.
    Control(Image),
    /// Data block n, counted from 0.
    Data(Image, usize),
    /// Block FFFFFFFFh.
    Last(Image),
    Raw(Image),
    Hex(Image),
    /// This many random bytes after the first 4 bytes of valid data.
    Noise(u64, usize),
}

/// The fault in a download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Flaw {
    None,
    /// A flipped bit in byte n, modulo the length.
    Bit(usize),
    /// A wrong CRC of the block, or a wrong checksum of a record; in the last block, a wrong CRC of
    /// the program.
    Crc,
    /// This address.
    Address(u32),
    /// The identity of another product.
    Product,
    /// A truncation after this many thousandths.
    Short(usize),
}

/// Data bytes of a block.
const CHUNK: usize = 96;

impl Image {
    fn bytes(self, setup: &Setup, flaw: Flaw) -> Vec<u8> {
        let product = PRODUCT_CODE ^ u32::from(flaw == Flaw::Product);
        program(setup.region(self.place), product, self.len, self.seed)
    }

    fn blocks(self) -> usize {
        self.len.div_ceil(CHUNK)
    }
}

impl Sent {
    fn bytes(self, setup: &Setup, flaw: Flaw) -> Vec<u8> {
        let mut bytes = match self {
            Self::Control(image) => {
                let product = PRODUCT_CODE ^ u32::from(flaw == Flaw::Product);
                block(0, 0, &words(&[image.len as u32, VENDOR_ID, product]))
            }
            Self::Data(image, n) => {
                let base = setup.region(image.place).base + (n * CHUNK) as u32;
                let address = if let Flaw::Address(address) = flaw { address } else { base };
                let bytes = image.bytes(setup, Flaw::None);
                let data = bytes.chunks(CHUNK).nth(n).unwrap_or(&[]);
                block(1 + n as u32, address, data)
            }
            Self::Last(image) => {
                let crc = crc32(&image.bytes(setup, Flaw::None)) ^ u32::from(flaw == Flaw::Crc);
                block(u32::MAX, 0, &words(&[image.len as u32, crc]))
            }
            Self::Raw(image) => {
                let mut bytes = image.bytes(setup, flaw);
                if let Flaw::Address(address) = flaw {
                    bytes[4..8].copy_from_slice(&address.to_le_bytes());
                }
                bytes
            }
            Self::Hex(image) => {
                let base = setup.region(image.place).base;
                let address = if let Flaw::Address(address) = flaw { address } else { base };
                hex(address, &image.bytes(setup, flaw))
            }
            Self::Noise(seed, len) => {
                let mut random = Random(seed);
                let starts: [&[u8]; 5] =
                    [b":020", &[0; 4], &[1, 0, 0, 0], &[0xC0, 0xFF, 0x01, 0x20], &[0xFF; 4]];
                let mut bytes = random.pick(&starts).to_vec();
                bytes.extend((0..len).map(|_| random.below(256) as u8));
                bytes
            }
        };
        match flaw {
            Flaw::Bit(n) => {
                let at = n % bytes.len();
                bytes[at] ^= 1 << (n / bytes.len() % 8);
            }
            Flaw::Crc if !matches!(self, Self::Last(_)) => {
                let at = bytes.len() - 1;
                bytes[at] ^= 1;
            }
            Flaw::Short(thousandths) => bytes.truncate(bytes.len() * (1000 - thousandths) / 1000),
            _ => {}
        }
        bytes
    }
}

impl Sent {
    /// The CRC of the program that the download makes or completes, if it is acceptable.
    fn crc(self, setup: &Setup, program: u8, flaw: Flaw) -> Option<u32> {
        match self {
            // Data may be any bytes.
            _ if setup.is_data(program) => Some(crc32(&self.bytes(setup, flaw))),
            // The label, if there is one, names another device.
            Self::Raw(image) | Self::Hex(image)
                if flaw == Flaw::Product && image.len >= label::OFFSET as usize + label::SIZE =>
            {
                None
            }
            // Any beginning of an image is an image, too.
            Self::Raw(_) => Some(crc32(&self.bytes(setup, flaw))),
            Self::Hex(image) => Some(crc32(&image.bytes(setup, flaw))),
            Self::Last(image) => Some(crc32(&image.bytes(setup, Flaw::None)) ^ u32::from(flaw == Flaw::Crc)),
            Self::Control(_) | Self::Data(..) | Self::Noise(..) => None,
        }
    }
}

// --- actions

/// The next action of the attacker.
#[derive(Clone, Copy, Debug)]
enum Action {
    /// Begins a download; an open one is cancelled first, as the SDO server does.
    Begin {
        program: u8,
        sent: Sent,
        flaw: Flaw,
        announced: bool,
    },
    /// Sends this many segments of it, as far as there is room.
    Send(usize),
    /// Sends the rest of it and its end.
    End,
    Cancel,
    /// 1F51h.
    Command {
        program: u8,
        value: u8,
    },
    /// Writes to the object for passwords.
    Password {
        program: u8,
        right: bool,
    },
    /// LSS: store.
    Store {
        id: u8,
    },
    Read {
        index: u16,
        sub: u8,
    },
    /// Reads 1F50h.
    Upload {
        program: u8,
    },
    Steps(u32),
    Settle,
    /// Advances the time, in ms.
    Wait(u32),
    Reset,
    /// Cuts the power after this many flash operations.
    Cut {
        after: u32,
        cut: Cut,
    },
    /// Makes a flash operation fail after this many operations.
    Fail {
        after: u32,
        fault: FlashFault,
    },
    /// Makes a flash operation do only a part and report success.
    Weak {
        after: u32,
        seed: u64,
    },
}

const COMMANDS: [u8; 9] = [0x00, 0x01, 0x01, 0x02, 0x03, 0x03, 0x80, 0x83, 0x84];
const INDICES: [u16; 9] = [0x1000, 0x1001, 0x1008, 0x100A, 0x1018, 0x1F51, 0x1F56, 0x1F57, 0x1F50];

/// Writes the list of actions for a seed.
struct Script {
    setup: &'static Setup,
    random: Random,
    actions: Vec<Action>,
    /// The probability of a disturbance, in percent.
    disturbed: usize,
    /// Whether flash faults and cuts are included.
    hostile_flash: bool,
}

impl Script {
    fn of(setup: &'static Setup, seed: u64) -> Vec<Action> {
        // Every setup has its own attacks.
        let mut random = Random(seed ^ u64::from(crc32(setup.name.as_bytes())) << 32);
        let disturbed = random.pick(&[0, 1, 3, 10, 40]);
        let hostile_flash = random.chance(50);
        let mut script = Self { setup, random, actions: Vec::new(), disturbed, hostile_flash };
        for _ in 0..2 + script.random.below(6) {
            if script.random.chance(75) {
                script.download();
            } else {
                script.disturb();
            }
        }
        script.actions
    }

    fn add(&mut self, action: Action) {
        self.actions.push(action);
        while self.random.chance(self.disturbed) {
            self.disturb();
        }
    }

    fn program(&mut self) -> u8 {
        1 + self.random.below(usize::from(self.setup.programs())) as u8
    }

    fn image(&mut self, program: u8) -> Image {
        // Sometimes for another program.
        let place = if self.random.chance(5) { self.program() } else { program };
        Image { place, len: 8 + self.random.below(1400), seed: self.random.below(256) as u8 }
    }

    fn flaw(&mut self) -> Flaw {
        let layout = self.setup.layout;
        let program = self.program();
        let region = self.setup.region(program);
        match self.random.below(6) {
            0 => Flaw::Bit(self.random.below(20_000)),
            1 => Flaw::Crc,
            2 => Flaw::Address(self.random.pick(&[
                layout.bootloader.base,
                layout.parameters[0].base,
                layout.parameters[1].end() - 4,
                region.base,
                region.base - 4,
                region.end() - 8,
                region.end(),
                0xFFFF_FFF0,
            ])),
            3 => Flaw::Product,
            _ => Flaw::Short(1 + self.random.below(999)),
        }
    }

    /// A download from its beginning: complete, faulty or aborted.
    fn download(&mut self) {
        let program = self.program();
        let mut image = self.image(program);
        // A lift accepts no program without a label.
        if self.random.chance(80) {
            image.len = image.len.max(label::OFFSET as usize + label::SIZE);
        }
        if self.random.chance(90) {
            if self.setup.password(program).is_some() {
                self.add(Action::Password { program, right: true });
            }
            if self.setup.password(program).is_none() || self.random.chance(20) {
                self.add(Action::Command { program, value: 0x03 });
            }
            if self.random.chance(70) {
                self.add(Action::Settle);
            }
        }
        let mut downloads: Vec<Sent> = match self.random.below(3) {
            0 => [Sent::Control(image)]
                .into_iter()
                .chain((0..image.blocks()).map(|n| Sent::Data(image, n)))
                .chain([Sent::Last(image)])
                .collect(),
            1 => vec![Sent::Raw(image)],
            _ => vec![Sent::Hex(image)],
        };
        let by_blocks = downloads.len() > 1;
        // Half of them are correct.
        let flawed = if self.random.chance(50) { self.random.below(downloads.len()) } else { usize::MAX };
        if by_blocks && self.random.chance(15) {
            downloads.truncate(self.random.below(downloads.len()));
        }
        for (n, sent) in downloads.into_iter().enumerate() {
            let flaw = if n == flawed { self.flaw() } else { Flaw::None };
            let announced = self.random.chance(50);
            self.add(Action::Begin { program, sent, flaw, announced });
            while self.random.chance(if by_blocks { 5 } else { 70 }) {
                let segments = 1 + self.random.below(60);
                self.add(Action::Send(segments));
                if self.random.chance(50) {
                    let steps = self.random.below(150) as u32;
                    self.add(Action::Steps(steps));
                }
            }
            if flaw != Flaw::None && self.random.chance(30) {
                self.add(Action::Cancel);
                break;
            }
            self.add(Action::End);
            if self.random.chance(if by_blocks { 30 } else { 50 }) {
                self.add(Action::Settle);
            }
        }
        if self.random.chance(60) {
            let value = self.random.pick(&[0x83, 0x01, 0x02]);
            self.add(Action::Command { program, value });
            self.add(Action::Settle);
        }
    }

    /// Any action.
    fn disturb(&mut self) {
        let random = &mut self.random;
        let program = random.below(usize::from(self.setup.programs()) + 1) as u8;
        let action = match random.below(if self.hostile_flash { 19 } else { 16 }) {
            0..=3 => {
                let value = if random.chance(90) { random.pick(&COMMANDS) } else { random.below(256) as u8 };
                Action::Command { program, value }
            }
            4 | 5 => Action::Password { program, right: random.chance(80) },
            6 => Action::Store { id: 1 + random.below(127) as u8 },
            7 if !(self.setup.profile.extras.read_back && random.chance(60)) => {
                Action::Read { index: random.pick(&INDICES), sub: random.below(4) as u8 }
            }
            7 | 8 => Action::Upload { program },
            9 => Action::Steps(1 + random.below(6) as u32),
            10 => Action::Steps(1 + random.below(400) as u32),
            11 => Action::Settle,
            12 => Action::Wait(random.pick(&[1, 100, 600, 40_000])),
            13 => Action::Reset,
            14 => Action::Cancel,
            15 => {
                let image = self.image(program.max(1));
                let random = &mut self.random;
                let sent = match random.below(4) {
                    0 => Sent::Noise(random.next(), random.below(300)),
                    1 => Sent::Raw(image),
                    2 => Sent::Control(image),
                    _ => Sent::Hex(image),
                };
                Action::Begin { program, sent, flaw: Flaw::None, announced: random.chance(50) }
            }
            16 => Action::Cut {
                after: 1 + random.below(200) as u32,
                cut: match random.below(4) {
                    0 => Cut::Before,
                    1 => Cut::After,
                    2 => Cut::Torn(random.next()),
                    _ => Cut::Unstable(random.next()),
                },
            },
            17 => Action::Fail {
                after: 1 + random.below(200) as u32,
                fault: random.pick(&[FlashFault::Failed, FlashFault::Protected, FlashFault::Verify]),
            },
            _ => Action::Weak { after: 1 + random.below(200) as u32, seed: random.next() },
        };
        self.actions.push(action);
    }
}

// --- the attack

/// An open download: its program, its bytes, and the number of sent bytes.
struct Open {
    program: u8,
    bytes: Vec<u8>,
    at: usize,
}

/// A set of programs.
#[derive(Clone, Copy, Default)]
struct Programs([bool; 3]);

impl Programs {
    fn add(&mut self, program: u8) {
        if let Some(place) = self.0.get_mut(usize::from(program)) {
            *place = true;
        }
    }

    fn has(&self, program: u8) -> bool {
        self.0[usize::from(program)]
    }
}

struct Attack {
    device: Rig,
    open: Option<Open>,
    now: u32,
    /// The programs that may be changed: those named by an action since the last time without work.
    named: Programs,
    /// Programs for which a start was requested.
    asked: Programs,
    /// START of this program was acknowledged, and no action followed.
    acknowledged: Option<u8>,
    /// Programs that were sent, and their CRCs.
    sent: Vec<(u8, u32)>,
    /// The stored values at the last check.
    stored: Stored,
    /// The values that LSS may have stored: the present ones, and the last acknowledged ones.
    nodes: Vec<NodeParameters>,
    storing: bool,
    /// The results of requests to start, at the last settling.
    requests: Vec<BootRequest>,
    /// The last step had no work, and no action followed.
    idle: bool,
}

/// More steps than any work takes.
const MOST_STEPS: u32 = 200_000;

impl Attack {
    fn new(setup: &'static Setup, buffer: usize) -> Self {
        let device = Rig::new(setup, buffer);
        let stored = device.stored();
        Self {
            device,
            open: None,
            now: 0,
            named: Programs::default(),
            asked: Programs::default(),
            acknowledged: None,
            sent: Vec::new(),
            nodes: vec![stored.node],
            stored,
            storing: false,
            requests: Vec::new(),
            idle: false,
        }
    }

    /// Carries out an action and checks the rules.
    fn act(&mut self, action: Action) -> Result<(), Broken> {
        let looking =
            matches!(action, Action::Steps(_) | Action::Settle | Action::Read { .. } | Action::Wait(_));
        if !looking {
            self.acknowledged = None;
            self.requests.clear();
        }
        self.idle = false;
        match caught(|| self.carry_out(action).and_then(|()| self.look())) {
            Ok(outcome) => outcome?,
            Err(cause) if cause.is::<PowerCut>() => {
                self.restart();
                caught(|| self.look()).map_err(|cause| Broken(Rule::Ends, panic_text(&*cause)))??;
            }
            Err(cause) => return Err(Broken(Rule::Ends, panic_text(&*cause))),
        }
        if self.idle {
            self.named = Programs::default();
        }
        Ok(())
    }

    fn carry_out(&mut self, action: Action) -> Result<(), Broken> {
        let setup = self.device.setup;
        match action {
            Action::Begin { program, sent, flaw, announced } => {
                self.cancel();
                if !setup.has(program) {
                    return Ok(());
                }
                let bytes = sent.bytes(setup, flaw);
                let size = announced.then_some(bytes.len() as u32);
                let begun = self.device.node.download_start(Address::new(0x1F50, program), size);
                if defined(begun)?.is_ok() {
                    self.named.add(program);
                    self.sent.extend(sent.crc(setup, program, flaw).map(|crc| (program, crc)));
                    self.open = Some(Open { program, bytes, at: 0 });
                }
            }
            Action::Send(segments) => {
                for _ in 0..segments {
                    if !self.segment()? {
                        break;
                    }
                }
            }
            Action::End => {
                let mut steps = 0;
                while self.open.as_ref().is_some_and(|open| open.at < open.bytes.len()) {
                    if !self.segment()? {
                        let idle = self.step();
                        steps += 1;
                        rule(!idle && steps < MOST_STEPS, Rule::Ends, || "there is never room".into())?;
                    }
                }
                if let Some(open) = self.open.take() {
                    self.named.add(open.program);
                    let ended = defined(self.device.node.download_end(Address::new(0x1F50, open.program)))?;
                    if ended.is_ok() && setup.profile.download.starts_by_itself {
                        self.asked.add(open.program);
                    }
                }
            }
            Action::Cancel => self.cancel(),
            Action::Command { program, value } => {
                if !setup.has(program) {
                    return Ok(());
                }
                let taken = defined(self.device.command(program, value))?.is_ok();
                if taken && matches!(value, 0x03 | 0x83 | 0x84) {
                    self.named.add(program);
                }
                // In CiA 302-3, 2 means reset, which starts the program for some profiles and after
                // a stream.
                if taken && matches!(value, 0x01 | 0x02) {
                    self.asked.add(program);
                }
                if taken && value == 0x01 {
                    self.acknowledged = Some(program);
                }
            }
            Action::Password { program, right } => {
                let Some((at, password)) = setup.password(program) else { return Ok(()) };
                if at.index == 0x7F50 && !setup.has(program) {
                    return Ok(());
                }
                let mut password = password.to_vec();
                password[0] ^= u8::from(!right);
                let taken = defined(self.device.node.write(at, &password))?;
                rule(right || taken.is_err(), Rule::DefinedValues, || "a wrong password was taken".into())?;
                if taken.is_ok() && at.index == 0x7F50 {
                    self.named.add(program);
                }
            }
            Action::Store { id } => {
                let rate = if id.is_multiple_of(2) { BitRate::K250 } else { BitRate::K500 };
                let node = NodeParameters { id: NodeId::new(id), bit_rate: rate };
                match self.device.node.store(node.id, Some(rate)) {
                    Poll::Ready(Err(_)) => {}
                    _ => {
                        self.nodes.push(node);
                        self.storing = true;
                    }
                }
            }
            Action::Read { index, sub } => {
                let at = Address::new(index, sub);
                if self.device.node.entries().iter().any(|entry| entry.at == at) && index != 0x1F50 {
                    let mut bytes = [0; 64];
                    let _ = defined(self.device.node.read(at, &mut bytes))?;
                }
            }
            Action::Upload { program } => {
                let at = Address::new(0x1F50, program);
                if !setup.has(program) || !setup.profile.extras.read_back {
                    return Ok(());
                }
                self.cancel();
                if let Ok(size) = defined(self.device.node.upload_start(at))? {
                    let mut bytes = vec![0; size.map_or(0, |size| size as usize)];
                    let read = defined(self.device.node.upload_data(at, 0, &mut bytes))?;
                    let crc = self.device.identification(program);
                    rule(read == Ok(bytes.len()) && crc32(&bytes) == crc, Rule::RecordIsTrue, || {
                        format!("1F50h/{program} reads back something else than 1F56h tells")
                    })?;
                }
            }
            Action::Steps(steps) => {
                for _ in 0..steps {
                    self.step();
                }
            }
            Action::Settle => self.settle()?,
            Action::Wait(ms) => {
                self.now += ms;
                self.device.node.set_time(Instant::from_millis(self.now));
            }
            Action::Reset => self.restart(),
            Action::Cut { after, cut } => {
                let mut flash = self.device.chip.model();
                flash.cut = Some((flash.operations + after, cut));
            }
            Action::Fail { after, fault } => {
                let mut flash = self.device.chip.model();
                flash.fail = Some((flash.operations + after, fault));
            }
            Action::Weak { after, seed } => {
                let mut flash = self.device.chip.model();
                flash.weak = Some((flash.operations + after, seed));
            }
        }
        Ok(())
    }

    /// Sends the next segment of the open download; returns whether it was sent.
    fn segment(&mut self) -> Result<bool, Broken> {
        let Some(open) = &mut self.open else { return Ok(false) };
        let at = Address::new(0x1F50, open.program);
        let rest = &open.bytes[open.at..];
        let segment = &rest[..rest.len().min(7)];
        if segment.is_empty() || self.device.node.download_space(at, false) < segment.len() {
            return Ok(false);
        }
        self.named.add(open.program);
        open.at += segment.len();
        if defined(self.device.node.download_data(at, segment))?.is_err() {
            self.cancel();
        }
        Ok(true)
    }

    fn cancel(&mut self) {
        if let Some(open) = self.open.take() {
            self.device.node.download_cancel(Address::new(0x1F50, open.program));
        }
    }

    fn step(&mut self) -> bool {
        self.idle = self.device.node.is_idle_after_step();
        self.idle
    }

    /// Runs until there is no work; acknowledged commands must have taken effect then.
    fn settle(&mut self) -> Result<(), Broken> {
        let mut steps = 0;
        while !self.step() {
            steps += 1;
            rule(steps < MOST_STEPS, Rule::Ends, || "the work does not end".into())?;
        }
        for program in 1..=self.device.setup.programs() {
            let status = self.device.status(program);
            rule(status & 1 == 0, Rule::Ends, || {
                format!("1F57h/{program} is busy, and there is no work: {status:#x}")
            })?;
        }
        self.requests.extend(self.device.node.take_boot_request());
        if let Some(program) = self.acknowledged {
            let told = self.device.status(program) != 0;
            let started = self.requests.iter().any(|request| number(*request) == Some(program));
            rule(started || told, Rule::StartsWhatWasAsked, || {
                format!("START of {program} was acknowledged; it neither starts nor is there an error")
            })?;
        }
        Ok(())
    }

    /// A reset, or the return of the power.
    fn restart(&mut self) {
        {
            let mut flash = self.device.chip.model();
            (flash.cut, flash.fail, flash.weak) = (None, None, None);
        }
        self.device.reset();
        self.open = None;
        self.storing = false;
        self.acknowledged = None;
        self.asked = Programs::default();
        self.requests.clear();
    }

    /// Checks all rules that can be checked at any time.
    fn look(&mut self) -> Result<(), Broken> {
        let setup = self.device.setup;
        let touched = std::mem::take(&mut self.device.chip.model().touched);
        for at in touched {
            let within = |region: &Region| region.contains(at.base, at.size);
            let named = (1..=setup.programs()).any(|n| self.named.has(n) && within(&setup.region(n)));
            rule(named || setup.layout.parameters.iter().any(within), Rule::OnlyTheNamedProgram, || {
                format!("{:#010x}, {} bytes", at.base, at.size)
            })?;
        }
        for program in 1..=setup.programs() {
            let (state, status) = (self.device.state(program), self.device.status(program));
            rule(
                [0, 3].contains(&state) && status & 0xFF00 == 0 && ERRORS.contains(&(status & 0xFE)),
                Rule::DefinedValues,
                || format!("program {program}: 1F51h reads {state:#x}, 1F57h {status:#x}"),
            )?;
            rule(self.device.is_true(program), Rule::RecordIsTrue, || {
                format!(
                    "1F51h/{program} says that there is a program, and nothing in flash has the CRC of 1F56h"
                )
            })?;
        }
        self.look_at_what_is_stored()?;
        self.requests.extend(self.device.node.take_boot_request());
        for request in self.requests.clone() {
            self.look_at_request(request)?;
        }
        // A running program is called back sooner or later.
        if !self.requests.is_empty() && self.acknowledged.is_none() {
            if self.device.node.is_finishing() {
                self.settle()?;
            }
            self.restart();
        }
        Ok(())
    }

    /// Bits between 0 and 1 read differently each time: check more than once.
    fn look_at_what_is_stored(&mut self) -> Result<(), Broken> {
        let setup = self.device.setup;
        if self.storing && self.device.node.stored() == Poll::Ready(Ok(())) {
            let last = self.nodes.split_off(self.nodes.len() - 1);
            self.nodes = last;
        }
        self.storing &= self.device.node.stored().is_pending();
        for _ in 0..2 {
            let stored = self.device.stored();
            rule(self.nodes.contains(&stored.node), Rule::OthersStay, || {
                format!("LSS: {:?}, where {:?} may be", stored.node, self.nodes)
            })?;
            for program in 1..=setup.programs() {
                let at = usize::from(program) - 1;
                let (before, now) = (self.stored.records[at], stored.records[at]);
                rule(before == now || self.named.has(program), Rule::OthersStay, || {
                    format!("the record of program {program} was {before:?}, is {now:?}, and nobody named it")
                })?;
                let Some((size, crc, ..)) = now else { continue };
                rule(self.sent.contains(&(program, crc)), Rule::RecordIsTrue, || {
                    format!("program {program} has the record {now:?}, and was not sent with that CRC")
                })?;
                let region = setup.region(program);
                let flash = self.device.chip.model();
                let program_flash = Region::new(region.base, size.min(region.size));
                let is_true = crc32(flash.cells(program_flash)) == crc && flash.is_stable(program_flash);
                rule(is_true, Rule::RecordIsTrue, || {
                    format!("program {program} has the record {now:?} after a reset, and is not what it says")
                })?;
            }
            self.stored = stored;
        }
        Ok(())
    }

    fn look_at_request(&self, request: BootRequest) -> Result<(), Broken> {
        let setup = self.device.setup;
        let what = || format!("{request:?}, and what was asked for is {:?}", self.asked.0);
        let Some(program) = number(request) else { return Err(Broken(Rule::StartsWhatWasAsked, what())) };
        let asked = setup.has(program) && self.asked.has(program) && !setup.is_data(program);
        rule(asked, Rule::StartsWhatWasAsked, what)?;
        let record = self.stored.records[usize::from(program) - 1];
        let signed = record.map(|(_, _, signed, _)| signed);
        let fits = match request {
            // After a download in one transfer, released or on trial.
            BootRequest::Fresh(_) => signed.is_some(),
            _ => signed == Some(matches!(request, BootRequest::Start(_))),
        };
        rule(fits, Rule::StartsWhatWasAsked, || format!("{request:?}, and its record is {record:?}"))
    }

    /// A host without knowledge of the history installs each program and starts it.
    fn repair(&mut self, random: &mut Random) -> Result<(), Broken> {
        let setup = self.device.setup;
        {
            let mut flash = self.device.chip.model();
            (flash.cut, flash.fail, flash.weak) = (None, None, None);
        }
        if random.chance(50) {
            self.act(Action::Reset)?;
        }
        for program in 1..=setup.programs() {
            let image = Image { place: program, len: 512 + random.below(900), seed: random.below(256) as u8 };
            self.act(Action::Cancel)?;
            self.act(Action::Settle)?;
            // A host with wrong passwords must wait.
            self.act(Action::Wait(60_000))?;
            let steps = |attack: &mut Self, what: &str, taken: Result<(), AbortCode>| {
                rule(taken.is_ok(), Rule::CanBeRepaired, || {
                    format!("{what} of program {program}: {taken:?}")
                })?;
                attack.settle()?;
                let status = attack.device.status(program);
                rule(status == 0, Rule::CanBeRepaired, || {
                    format!("{what} of program {program}: 1F57h is {status:#x}")
                })
            };
            self.named.add(program);
            let (what, taken) = match setup.password(program) {
                Some(_) => ("the password", self.device.unlock(program)),
                None => ("CLEAR", self.device.command(program, 0x03)),
            };
            steps(self, what, taken)?;
            let kind = if setup.is_data(program) { 1 } else { random.below(3) };
            let downloads = match kind {
                0 => [Sent::Control(image)]
                    .into_iter()
                    .chain((0..image.blocks()).map(|n| Sent::Data(image, n)))
                    .chain([Sent::Last(image)])
                    .collect(),
                1 => vec![Sent::Raw(image)],
                _ => vec![Sent::Hex(image)],
            };
            for sent in downloads {
                self.named.add(program);
                self.sent.extend(sent.crc(setup, program, Flaw::None).map(|crc| (program, crc)));
                let taken = self.device.send(program, &sent.bytes(setup, Flaw::None));
                steps(self, &format!("{sent:?}"), taken)?;
            }
            if setup.profile.download.starts_by_itself && kind != 0 {
                self.asked.add(program);
            }
            let bytes = image.bytes(setup, Flaw::None);
            let (state, told) = (self.device.state(program), self.device.identification(program));
            let there = self.device.cells(program)[..bytes.len()] == bytes;
            rule(there && state == 0 && told == crc32(&bytes), Rule::CanBeRepaired, || {
                format!(
                    "program {program} was sent in full: 1F51h {state}, 1F56h {told:#x}, in flash: {there}"
                )
            })?;
            if !self.requests.is_empty() {
                self.look()?;
                continue;
            }
            if kind == 0 {
                self.named.add(program);
                let taken = self.device.command(program, 0x83);
                steps(self, "SET_SIGNATURE", taken)?;
            }
            if !setup.is_data(program) {
                self.look()?;
                self.act(Action::Command { program, value: 0x01 })?;
                self.act(Action::Settle)?;
                let signed = self.stored.records[usize::from(program) - 1].is_some_and(|record| record.2);
                rule(signed, Rule::CanBeRepaired, || format!("program {program} is not signed"))?;
                rule(self.device.status(program) == 0, Rule::CanBeRepaired, || {
                    format!("START of program {program} ends with an error")
                })?;
            }
        }
        Ok(())
    }
}

/// The program to start.
fn number(request: BootRequest) -> Option<u8> {
    match request {
        BootRequest::Start(program) | BootRequest::Trial(program) | BootRequest::Fresh(program) => {
            Some(program)
        }
        _ => None,
    }
}

/// Whether an abort code is documented.
fn defined<T>(outcome: Result<T, AbortCode>) -> Result<Result<T, AbortCode>, Broken> {
    if let Err(abort) = &outcome {
        rule(ABORTS.contains(&abort.0), Rule::DefinedValues, || format!("{abort:?}"))?;
    }
    Ok(outcome)
}

fn panic_text(cause: &(dyn std::any::Any + Send)) -> String {
    let text = cause.downcast_ref::<String>().map(String::as_str);
    format!("a panic: {}", text.or(cause.downcast_ref::<&str>().copied()).unwrap_or("?"))
}

// --- runs

/// Runs a list of actions; returns the number of the action that broke a rule, or of all actions if
/// the repair failed.
fn play(setup: &'static Setup, seed: u64, actions: &[Action]) -> Result<(), (usize, Broken)> {
    let mut random = Random(!seed);
    let mut attack = Attack::new(setup, random.pick(&[256, 1024]));
    for (n, action) in actions.iter().enumerate() {
        attack.act(*action).map_err(|broken| (n, broken))?;
    }
    let repaired = caught(|| attack.repair(&mut random))
        .unwrap_or_else(|cause| Err(Broken(Rule::Ends, panic_text(&*cause))));
    repaired.map_err(|broken| (actions.len(), broken))
}

/// Removes the actions that are not necessary to break the rule.
fn shortened(setup: &'static Setup, seed: u64, mut actions: Vec<Action>, rule: Rule) -> Vec<Action> {
    let breaks = |actions: &[Action]| match play(setup, seed, actions) {
        Err((n, Broken(broken, _))) if broken == rule => Some(n),
        _ => None,
    };
    let mut size = actions.len().next_power_of_two();
    while size > 0 {
        let mut from = 0;
        while from < actions.len() {
            let mut fewer = actions.clone();
            fewer.drain(from..(from + size).min(actions.len()));
            match breaks(&fewer) {
                Some(n) => {
                    fewer.truncate(n + 1);
                    actions = fewer;
                }
                None => from += size,
            }
        }
        size /= 2;
    }
    actions
}

struct Failure {
    seed: u64,
    actions: Vec<Action>,
    broken: Broken,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Broken(rule, what) = &self.broken;
        writeln!(f, "seed {}: {rule:?}: {what}; the actions, shortened:", self.seed)?;
        self.actions.iter().enumerate().try_for_each(|(n, action)| writeln!(f, "  {n:>3} {action:?}"))
    }
}

fn attack(setup: &'static Setup, seed: u64) -> Result<usize, Failure> {
    let actions = Script::of(setup, seed);
    let count = actions.len();
    let Err((n, Broken(rule, _))) = play(setup, seed, &actions) else { return Ok(count) };
    let actions = shortened(setup, seed, actions[..actions.len().min(n + 1)].to_vec(), rule);
    let Err((_, broken)) = play(setup, seed, &actions) else { unreachable!("it breaks the rule") };
    Err(Failure { seed, actions, broken })
}

fn environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|value| value.parse().unwrap_or_else(|_| panic!("{name} is no number")))
}

/// The number of seeds for each setup.
const ATTACKS: u64 = 300;

/// Runs the attacks on a setup; fails with the first attack on each rule.
fn attacks(setup: &'static Setup) {
    let seeds = match environment("COBOOT_ATTACK_SEED") {
        Some(seed) => {
            println!("{:#?}", Script::of(setup, seed));
            seed..seed + 1
        }
        None => 0..environment("COBOOT_ATTACKS").unwrap_or(ATTACKS),
    };
    let mut failures: Vec<Failure> = Vec::new();
    let (mut actions, mut failed) = (0, 0);
    for seed in seeds.clone() {
        match attack(setup, seed) {
            Ok(count) => actions += count,
            Err(failure) => {
                failed += 1;
                if failures.iter().all(|told| told.broken.0 != failure.broken.0) {
                    failures.push(failure);
                }
            }
        }
        if failed == 20 {
            break;
        }
    }
    println!("{}: {} attacks of {actions} actions", setup.name, seeds.end - seeds.start);
    let told: Vec<_> = failures.iter().map(Failure::to_string).collect();
    assert!(failed == 0, "{}: {failed} attacks broke a rule; one of each:\n{}", setup.name, told.join("\n"));
}

macro_rules! attacked {
    ($($test:ident: $setup:ident),*) => {
        $(
            #[test]
            fn $test() {
                attacks(&kit::rig::$setup);
            }
        )*
    };
}

attacked! {
    standard_1: STANDARD_1,
    standard_2: STANDARD_2,
    at_once_2: AT_ONCE_2,
    paulus_1: PAULUS_1,
    paulus_2: PAULUS_2,
    esacademy_1: ESACADEMY_1,
    esacademy_2: ESACADEMY_2,
    lift_1: LIFT_1,
    lift_2: LIFT_2
}
