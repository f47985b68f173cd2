//! A seeded attacker of sealed devices: valid images, wrong ones and unsealed ones, aborted
//! anywhere, with commands, passwords, LSS, resets, power cuts and flash faults in between. After
//! any action, a program that the boot stage would start is authentic and complete; the counter
//! never decreases; and at the end a valid image can be installed.
//!
//! The same seed gives the same attack:
//!
//! ```sh
//! COBOOT_ATTACKS=20000 cargo test --release -p coboot-tests --test sealed attacker::   # seeds per setup
//! COBOOT_ATTACK_SEED=4711 cargo test -p coboot-tests --test sealed attacker::          # printed
//! ```

use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::OnceLock;
use std::task::Poll;

use boot_core::canopen::{BitRate, Instant, NodeId};
use boot_core::flash::FlashFault;
use coboot_tests::sealed::{
    block, certificate, crc32, image, keys, seal, sealer, Device, Host, Parts, Setup, CONFIRMED_2,
    ESACADEMY_2, FORMS, LIFT_2, STANDARD_1, STANDARD_2,
};
use coflash_core::file::sealed::{Certificate, Sealer};
use kit::ihex::intel_hex;
use kit::model::{until_power_cut, Cut};
use kit::random::Random;
use seal::access::right;

/// An image that the owner of the key has sealed for a program.
struct Made {
    program: u8,
    image: Vec<u8>,
    file: Vec<u8>,
    counter: u32,
    version: u32,
}

/// All images of a setup; the last one of each program has the highest counter.
fn made(setup: &Setup) -> Vec<Made> {
    let mut all = Vec::new();
    for program in 1..=setup.programs() {
        let place = setup.region(program);
        for (n, counter) in [3, 3, 5, 5, 7, 9].into_iter().enumerate() {
            let version = n as u32 + 1;
            let len = [8, 300, 1024, 1500, 2100, 700][n];
            let image = image(place, len, (16 * program) + n as u8);
            let sealer = Sealer {
                program,
                counter,
                version,
                chunk: 9 + n as u8 % 3,
                data: setup.is_data(program),
                ..sealer(FORMS[n % 4])
            };
            all.push(Made { program, file: seal(&sealer, &image), image, counter, version });
        }
    }
    all
}

static SETUPS: [&Setup; 5] = [&STANDARD_1, &STANDARD_2, &CONFIRMED_2, &ESACADEMY_2, &LIFT_2];

fn world(setup: usize) -> &'static [Made] {
    static WORLDS: OnceLock<Vec<Vec<Made>>> = OnceLock::new();
    &WORLDS.get_or_init(|| SETUPS.iter().map(|setup| made(setup)).collect())[setup]
}

// --- the data that is sent

/// A valid file, or one made from valid files.
fn file(random: &mut Random, setup: &Setup, world: &[Made], program: u8) -> (String, Vec<u8>) {
    let one = &world[random.below(world.len())];
    let fitting: Vec<&Made> = world.iter().filter(|made| made.program == program).collect();
    let fit = if fitting.is_empty() || random.chance(10) { one } else { random.pick(&fitting) };
    let name = format!("{}/{}", fit.program, fit.version);
    let good = fit.file.clone();
    let parts = || Parts::of(&good);
    match random.below(14) {
        0..=4 => (format!("image {name}"), good),
        5 => {
            let mut file = good;
            let at = random.below(file.len());
            file[at] ^= 1 << random.below(8);
            (format!("image {name} with a flip in byte {at}"), file)
        }
        6 => {
            let len = random.below(good.len());
            (format!("{len} bytes of image {name}"), good[..len].to_vec())
        }
        7 => {
            let more = 1 + random.below(600);
            (format!("image {name} and {more} bytes"), [good, vec![0x5A; more]].concat())
        }
        8 => {
            // The head of one image with chunks of another.
            let other =
                Parts::of(&random.pick(&fitting.iter().copied().chain([one]).collect::<Vec<_>>()).file);
            let head = parts();
            (format!("head of {name} with other chunks"), Parts { chunks: other.chunks, ..head }.bytes())
        }
        9 => {
            // A chunk repeated or left out.
            let head = parts();
            let size = 32 + (1 << head.manifest[25]);
            let mut chunks: Vec<&[u8]> = head.chunks.chunks(size).collect();
            let at = random.below(chunks.len());
            if random.chance(50) {
                chunks.insert(at, chunks[at]);
            } else {
                chunks.remove(at);
            }
            let chunks = chunks.concat();
            (format!("image {name} with chunk {at} twice or not"), Parts { chunks, ..head.clone() }.bytes())
        }
        10 => {
            // An image of a stranger, with a certificate made by himself.
            let Some(stranger) = keys().stranger.public().into() else { unreachable!() };
            let own = Certificate { key: stranger, ..certificate() };
            let mut bytes = own.signed_by(&keys().stranger);
            bytes[60..64].copy_from_slice(&keys().root.public().id().to_le_bytes());
            let counter = 500_u32.to_le_bytes();
            let file = parts().with(20, &counter).certified(&bytes).signed_by(&keys().stranger).bytes();
            (format!("image {name} of a stranger"), file)
        }
        11 => ("a raw image".into(), image(setup.region(program), 8 + random.below(900), 0xEE)),
        12 => {
            let bytes = image(setup.region(program), 8 + random.below(900), 0xDD);
            ("Intel HEX".into(), intel_hex(setup.region(program).base, &bytes).into_bytes())
        }
        _ => {
            let mut bytes = b"CBS1".to_vec();
            bytes.extend((0..random.below(700)).map(|_| random.below(256) as u8));
            ("noise".into(), bytes)
        }
    }
}

// --- the attack

/// The history of the device.
#[derive(Default)]
struct Past {
    /// The counters in the store, by program.
    stored: [u32; 3],
    /// The highest counter of a program that had proved itself.
    proved: [u32; 3],
    /// The installed programs at the last check.
    was: [Option<(u32, u32)>; 3],
}

struct Attack<'w> {
    setup: &'static Setup,
    world: &'w [Made],
    random: Random,
    told: Vec<String>,
    past: Past,
    /// Whether cuts and faults of the flash are included.
    hostile_flash: bool,
    /// Whether the flash has reported a success that was none.
    was_weak: bool,
    installed: u32,
}

impl Attack<'_> {
    fn tell(&mut self, what: String) {
        self.told.push(what);
    }

    /// Checks the rules that must hold after any action, on a copy, as after a reset.
    fn look(&mut self, device: &Device) {
        let device = device.copy();
        for program in 1..=self.setup.programs() {
            let at = usize::from(program);
            let counter = device.counter(program);
            assert!(counter >= self.past.stored[at], "program {program}: counter {counter} went back");
            self.past.stored[at] = counter;
            let Some(record) = device.record(program) else {
                self.past.was[at] = None;
                continue;
            };
            assert!(record.is_sealed(), "program {program}: a record of an unsealed program");
            // A reset may find bits between 0 and 1; the boot stage then checks the CRC.
            let mut authentic = self.world.iter().filter(|made| {
                made.program == program
                    && (made.image.len() as u32, made.version) == (record.size, record.version)
            });
            let made = authentic.next().expect("nothing but authentic images has a record");
            if self.setup.is_data(program) || device.verified(program).is_ok() {
                assert!(
                    self.was_weak || device.cells(program, made.image.len()) == made.image,
                    "program {program} is not what was sealed"
                );
            } else {
                assert!(self.was_weak, "program {program}: the record is not true");
            }
            let confirmed = self.setup.name.starts_with("CONFIRMED");
            if !confirmed {
                assert!(counter >= made.counter, "program {program} is there before its counter");
            }
            let is = Some((made.version, made.counter));
            if self.past.was[at] != is {
                self.installed += 1;
                assert!(
                    made.counter >= self.past.proved[at],
                    "program {program}: counter {} behind {}",
                    made.counter,
                    self.past.proved[at]
                );
            }
            self.past.was[at] = is;
            if record.confirmed || !confirmed {
                self.past.proved[at] = self.past.proved[at].max(made.counter);
            }
        }
    }

    /// A disturbance.
    fn disturb(&mut self, host: &mut Host<'_>) {
        if self.random.chance(5) {
            // With the right to do so, and without.
            let right =
                self.random.pick(&[right::ERASE, right::CLEAR_SIGNATURE, right::STORE, right::READ_BACK]);
            let key = self.random.pick(&[&keys().root, &keys().root, &keys().stranger, &keys().release]);
            let granted = host.grant(key, right, 0);
            assert!(!granted || std::ptr::eq(key, &keys().root), "rights for a stranger");
            self.tell(format!("{key:?} asks for right {right}: {granted}"));
        }
        let program = self.random.below(usize::from(self.setup.programs()) + 1) as u8;
        match self.random.below(if self.hostile_flash { 16 } else { 13 }) {
            0..=3 => {
                let command = self.random.pick(&[0, 1, 2, 3, 3, 0x80, 0x83, 0x84]);
                let answer = host.command(program, command).is_ok();
                self.tell(format!("command {command:02X}h of {program}: {answer}"));
            }
            4 => self.password(host, program),
            5 => {
                let id = NodeId::new(1 + self.random.below(127) as u8);
                let stores = host.node.store(id, Some(BitRate::K125));
                self.tell(format!("LSS store: {}", stores == Poll::Pending));
            }
            6 | 7 => {
                let steps = 1 + self.random.below(300);
                host.steps(steps);
                self.tell(format!("{steps} steps"));
            }
            8 => {
                host.settle();
                self.tell("settled".into());
            }
            9 => {
                host.now += self.random.pick(&[1, 600, 40_000]);
                host.node.set_time(Instant::from_millis(host.now));
            }
            10 => {
                host.cancel(program);
                self.tell(format!("cancel of {program}"));
            }
            11 => {
                let (what, bytes) = file(&mut self.random, self.setup, self.world, program.max(1));
                let some = self.random.below(bytes.len().min(900) + 1);
                let answer = host.begin(program, &bytes[..some], 7);
                self.tell(format!("{some} bytes of {what} to {program}: {answer:?}"));
            }
            12 => {
                let idle = (1..=self.setup.programs()).all(|program| host.status(program) & 1 == 0);
                if idle {
                    host.node.confirm(program);
                    self.tell(format!("program {program} came back"));
                }
            }
            13 => {
                let after = 1 + self.random.below(250) as u32;
                let cut = match self.random.below(4) {
                    0 => Cut::Before,
                    1 => Cut::After,
                    2 => Cut::Torn(self.random.next()),
                    _ => Cut::Unstable(self.random.next()),
                };
                let mut model = host.device.chip.model();
                model.cut = Some((model.operations + after, cut));
                drop(model);
                self.tell(format!("{cut:?} {after} operations later"));
            }
            14 => {
                let after = 1 + self.random.below(250) as u32;
                let fault =
                    self.random.pick(&[FlashFault::Failed, FlashFault::Protected, FlashFault::Verify]);
                let mut model = host.device.chip.model();
                model.fail = Some((model.operations + after, fault));
                drop(model);
                self.tell(format!("{fault:?} {after} operations later"));
            }
            _ => {
                let after = 1 + self.random.below(250) as u32;
                let seed = self.random.next();
                let mut model = host.device.chip.model();
                model.weak = Some((model.operations + after, seed));
                drop(model);
                self.was_weak = true;
                self.tell(format!("a weak operation {after} later"));
            }
        }
    }

    fn password(&mut self, host: &mut Host<'_>, program: u8) {
        let Some((at, password)) = self.setup.password(program) else { return };
        let answer = host.node.write(at, password);
        self.tell(format!("password for {program}: {answer:?}"));
    }

    /// One transfer.
    fn send(&mut self, host: &mut Host<'_>, disturbed: usize, program: u8, what: &str, bytes: &[u8]) {
        let piece = 1 + self.random.below(7);
        let mut sent = 0;
        let mut answer = host.begin(program, &[], 7);
        self.tell(format!("{what} to {program}, {piece} bytes at a time: {answer:?}"));
        while sent < bytes.len() && answer.is_ok() {
            let some = (1 + self.random.below(400)).min(bytes.len() - sent);
            answer = host.go_on(program, &bytes[sent..sent + some], piece);
            sent += some;
            if self.random.chance(disturbed) {
                self.tell(format!("{sent} bytes sent: {answer:?}"));
                self.disturb(host);
                self.look(host.device);
            }
        }
        if answer.is_ok() {
            answer = host.end(program);
            self.tell(format!("end: {answer:?}"));
        }
    }

    /// A block file: a transfer for each block, sometimes with a block out of order, repeated or
    /// damaged.
    fn send_in_blocks(
        &mut self,
        host: &mut Host<'_>,
        disturbed: usize,
        program: u8,
        what: &str,
        bytes: &[u8],
    ) {
        let base = self.setup.region(program).base;
        let size = 1 + self.random.below(600);
        let mut blocks = vec![block(0, 0, &[0; 8])];
        let mut address = base;
        for (number, data) in (1..).zip(bytes.chunks(size)) {
            blocks.push(block(number, address, data));
            address += data.len() as u32;
        }
        let last = [bytes.len() as u32, crc32(bytes)];
        blocks.push(block(u32::MAX, 0, &last.map(u32::to_le_bytes).concat()));
        if self.random.chance(20) {
            let (at, other) = (self.random.below(blocks.len()), self.random.below(blocks.len()));
            match self.random.below(4) {
                0 => drop(blocks.remove(at)),
                1 => blocks.insert(other, blocks[at].clone()),
                2 => blocks.swap(at, other),
                _ => blocks[at][other % 12] ^= 1 << self.random.below(8),
            }
        }
        for block in &blocks {
            self.send(host, disturbed, program, &format!("a block of {} of {what}", block.len()), block);
            if self.random.chance(70) {
                host.settle();
            }
        }
    }

    fn download(&mut self, host: &mut Host<'_>, disturbed: usize) {
        let program = 1 + self.random.below(usize::from(self.setup.programs())) as u8;
        let (what, bytes) = file(&mut self.random, self.setup, self.world, program);
        if self.random.chance(80) {
            host.wait();
        }
        if self.random.chance(90) {
            self.password(host, program);
            let answer = host.command(program, 3);
            self.tell(format!("CLEAR of {program}: {answer:?}"));
            if self.random.chance(70) {
                host.settle();
            }
        }
        if self.random.chance(30) {
            self.send_in_blocks(host, disturbed, program, &what, &bytes);
        } else {
            self.send(host, disturbed, program, &what, &bytes);
        }
        while self.random.chance(disturbed) {
            self.disturb(host);
        }
        if self.random.chance(80) {
            host.settle();
            let status = host.status(program);
            self.tell(format!("settled: {status:02X}h"));
            assert_eq!(status & 1, 0, "busy without work");
            if self.random.chance(30) {
                host.confirm(program);
                self.tell("confirmed".into());
            }
        }
        self.look(host.device);
    }

    /// Actions until a reset, a start or a power cut.
    fn boot(&mut self, device: &Device) {
        let cut = until_power_cut(|| {
            device.run(|host| {
                let disturbed = self.random.pick(&[0, 2, 10, 40]);
                for _ in 0..1 + self.random.below(4) {
                    self.download(host, disturbed);
                    if let Some(request) = host.node.take_boot_request() {
                        self.tell(format!("{request:?} starts {:?}", device.starts(Some(request))));
                        return;
                    }
                    // A reset in the middle of the actions.
                    if self.random.chance(15) {
                        return;
                    }
                }
            });
        });
        self.tell(if cut { "the power was cut" } else { "reset" }.into());
        device.chip.model().power_on();
        self.look(device);
    }

    fn play(&mut self) {
        let device = Device::sealed(self.setup);
        for _ in 0..1 + self.random.below(4) {
            self.boot(&device);
        }
        // The flash works again, and the owner sends an image.
        {
            let mut model = device.chip.model();
            (model.fail, model.weak, model.cut) = (None, None, None);
        }
        for program in 1..=self.setup.programs() {
            let last = self.world.iter().rev().find(|made| made.program == program).expect("there is one");
            device.run(|host| host.install(program, &last.file));
            self.was_weak = false;
            assert_eq!(device.cells(program, last.image.len()), last.image);
            assert!(self.setup.is_data(program) || device.holds(program, &last.image));
        }
    }
}

/// The attack of a seed on a setup; returns its actions and the broken rule, if any.
fn attack(setup: usize, seed: u64) -> Result<u32, String> {
    let mut random = Random(seed ^ (setup as u64) << 48);
    let hostile_flash = random.chance(50);
    let mut attack = Attack {
        setup: SETUPS[setup],
        world: world(setup),
        random,
        told: Vec::new(),
        past: Past::default(),
        hostile_flash,
        was_weak: false,
        installed: 0,
    };
    let outcome = catch_unwind(AssertUnwindSafe(|| attack.play()));
    if std::env::var_os("COBOOT_ATTACK_SEED").is_some() {
        println!("{}: {}", attack.setup.name, attack.told.join("\n  "));
    }
    match outcome {
        Ok(()) => Ok(attack.installed),
        Err(cause) => {
            let text = cause.downcast_ref::<String>().cloned();
            let text = text.or_else(|| cause.downcast_ref::<&str>().map(ToString::to_string));
            let what = text.unwrap_or_else(|| "a panic".into());
            Err(format!("{} seed {seed}: {what}\n  {}", attack.setup.name, attack.told.join("\n  ")))
        }
    }
}

#[test]
fn whatever_is_done_what_starts_is_authentic() {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let seeds = match number("COBOOT_ATTACK_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("COBOOT_ATTACKS").unwrap_or(300),
    };
    let (mut installed, mut broken) = (0, Vec::new());
    for setup in 0..SETUPS.len() {
        for seed in seeds.clone() {
            match attack(setup, seed) {
                Ok(count) => installed += count,
                Err(what) => broken.push(what),
            }
            assert!(broken.len() < 3, "{}", broken.join("\n\n"));
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n\n"));
    println!("{installed} images were installed meanwhile");
    // The attack is on a working device.
    assert!(seeds.end - seeds.start < 300 || installed > 1000, "{installed}");
}
