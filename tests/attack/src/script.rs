//! The actions of an attack.

use boot_core::flash::FlashFault;
use kit::bench::{CLEAR, SET_SIGNATURE as CONFIRM, START};
use kit::model::Cut;
use kit::random::Random;
use kit::rig::{crc32, Setup};
use seal::access::right;
use shared_abi::renewal::{Origin, State};

use crate::device::{Action, Holder, Observation, Trouble};
use crate::files::{file, free, Changes, Content, Extent, Flaw, Part, Sent, RELEASES};

/// Commands of 1F51h.
const COMMANDS: [u8; 9] = [0, START, 2, CLEAR, CLEAR, 0x80, CONFIRM, CONFIRM, 0x84];
const IMAGES: [u8; 6] = [1, 6, 2, 2, 4, 5];
const EXTENTS: [Extent; 4] = [Extent::Small, Extent::Small, Extent::Large, Extent::Untold];

const INDICES: [u16; 9] = [0x1000, 0x1001, 0x1008, 0x100A, 0x1018, 0x1F51, 0x1F56, 0x1F57, 0x1F50];

/// The kinds of actions. The last two, which a renewal needs, are in each attack.
const KINDS: usize = 22;

/// What draws.
enum Source<'a> {
    Seed(Random),
    /// The bytes of a fuzzer, and zeros after them.
    Bytes(&'a [u8]),
}

impl Source<'_> {
    fn bytes(&mut self, count: usize) -> u64 {
        let Self::Bytes(bytes) = self else { unreachable!("a seed has no end") };
        let (first, rest) = bytes.split_at(count.min(bytes.len()));
        *bytes = rest;
        first.iter().fold(0, |number, byte| number << 8 | u64::from(*byte))
    }

    fn next(&mut self) -> u64 {
        match self {
            Self::Seed(random) => random.next(),
            Self::Bytes(_) => self.bytes(4),
        }
    }

    fn below(&mut self, end: usize) -> usize {
        match self {
            Self::Seed(random) => random.below(end),
            Self::Bytes(_) => self.bytes(if end > 256 { 2 } else { 1 }) as usize % end,
        }
    }

    fn chance(&mut self, percent: usize) -> bool {
        self.below(100) < percent
    }

    fn pick<T: Copy>(&mut self, among: &[T]) -> T {
        among[self.below(among.len())]
    }

    fn noise(&mut self) -> Content {
        match self {
            Self::Seed(random) => Content::Noise(random.next()),
            Self::Bytes(_) => {
                let size = self.below(256);
                let Self::Bytes(bytes) = self else { unreachable!() };
                let (first, rest) = bytes.split_at(size.min(bytes.len()));
                *bytes = rest;
                free(first)
            }
        }
    }
}

struct Script<'a> {
    setup: &'static Setup,
    random: Source<'a>,
    actions: Vec<Action>,
    /// A reset may have come since the last password.
    is_locked: bool,
}

/// The actions of a seed.
pub fn of(setup: &'static Setup, seed: u64) -> Vec<Action> {
    // Each product has its own attacks.
    let mut random = Random(seed ^ u64::from(crc32(setup.name.as_bytes())) << 32);
    // Of the other kinds some alone: what one needs, another one always undoes.
    let mut kinds: Vec<usize> = (0..KINDS - 2).filter(|_| random.chance(40)).collect();
    kinds.extend([KINDS - 2, KINDS - 1, KINDS - 1]);
    let count = random.below(60);
    let mut script = Script { setup, random: Source::Seed(random), actions: Vec::new(), is_locked: true };
    for _ in 0..count {
        let kind = script.random.pick(&kinds);
        script.draw(kind);
        script.run();
    }
    script.actions
}

/// The actions of the bytes of a fuzzer.
pub fn of_bytes(setup: &'static Setup, bytes: &[u8]) -> Vec<Action> {
    let mut script = Script { setup, random: Source::Bytes(bytes), actions: Vec::new(), is_locked: true };
    while !matches!(script.random, Source::Bytes([])) {
        let kind = script.random.below(KINDS);
        script.draw(kind);
        script.run();
    }
    script.actions
}

impl Script<'_> {
    fn draw(&mut self, kind: usize) {
        let random = &mut self.random;
        let program = 1 + random.below(self.setup.programs().into()) as u8;
        // Mostly small, and sometimes for another place.
        let least = random.pick(&[8, 0x200, 0x280]);
        let bytes = Extent::Bytes(least + 4 * random.below(40));
        let extent = if random.chance(50) { random.pick(&EXTENTS) } else { bytes };
        let place = if random.chance(5) { 1 } else { program };
        let row = random.below(RELEASES.len()) as u8;
        // Each program that is sealed otherwise has the highest counter.
        let is_release = random.chance(if self.setup.takes_sealed { 80 } else { 10 });
        let of_program =
            if is_release { Content::Release(place, row) } else { Content::Program(place, extent) };
        let renews = self.setup.profile.extras.bootloader;
        let own = renews.unwrap_or(program);
        // Without a renewal there are programs alone.
        let image = renews.map_or(of_program, |_| Content::Image(random.pick(&IMAGES)));
        let any = 1 + random.below(4) as u8;
        let sub = random.pick(&[program, program, own, own, any]);
        let far = random.pick(&[25, 80, 300]);
        let after = 1 + random.below(far) as u32;
        let seed = random.next();
        let cut = random.pick(&[Cut::Before, Cut::After, Cut::Torn(seed), Cut::Unstable(seed)]);
        let faults = [FlashFault::Failed, FlashFault::Failed, FlashFault::Protected, FlashFault::Verify];
        let fails = Trouble::Fail(random.pick(&faults));
        match kind {
            0 | 1 => {
                let value = if random.chance(95) { random.pick(&COMMANDS) } else { seed as u8 };
                self.actions.push(Action::Command { sub, value });
            }
            2 => self.actions.push(Action::Password { sub, is_right: random.chance(80) }),
            5 | 6 => self.download(program, of_program),
            7 => {
                // Of one of two masters, which may not end it.
                let noise = random.noise();
                let content = random.pick(&[of_program, of_program, image, noise]);
                let block = random.below(3);
                let part = random.pick(&[Part::Block(block), Part::Whole, Part::Hex]);
                let bytes = random.chance(60).then(|| random.below(1500));
                let sent = Sent { content, part, flaw: self.flaw(20) };
                self.actions.push(Action::Send { sub, sent, is_announced: seed.is_multiple_of(2), bytes });
                self.actions.extend(seed.is_multiple_of(3).then_some(Action::Cancel));
            }
            8 => self.actions.push(Action::Wait(random.pick(&[1, 1000, 40_000, 60_000]))),
            9 => self.actions.push(Action::Store(1 + (seed % 127) as u8)),
            10 => self.reset(Action::ResetNode),
            11 => self.reset(Action::PowerOff),
            12 => self.reset(Action::Flash(after, Trouble::Cut(cut))),
            13 => self.actions.push(Action::Flash(after, random.pick(&[Trouble::Dip, fails]))),
            14 => self.actions.push(Action::Flash(after, Trouble::Weak(seed))),
            15 => self.reset(Action::Rot(seed as usize, (seed >> 32) as u8)),
            16 if seed.is_multiple_of(3) => self.actions.push(Action::Upload { sub: program }),
            16 => self.actions.push(Action::Read { index: random.pick(&INDICES), sub: any - 1 }),
            17 => self.reset(Action::Crash),
            18 if self.setup.takes_sealed => {
                let holder = random.pick(&[Holder::Root, Holder::Root, Holder::Release, Holder::Stranger]);
                let rights = [right::ERASE, right::CLEAR_SIGNATURE, right::STORE, right::READ_BACK];
                self.actions.push(Action::Right(holder, random.pick(&rights)));
            }
            18 | 19 => self.actions.extend([Action::Settle, Action::Return(program)]),
            20 => self.go_on(),
            21 if renews.is_some() => {
                let image = if seed.is_multiple_of(4) { image } else { Content::Image(1) };
                self.actions.extend(self.is_locked.then_some(Action::Password { sub: own, is_right: true }));
                if self.random.chance(40) {
                    let trouble = self.random.pick(&[Trouble::Dip, fails]);
                    self.actions.push(Action::Flash(after, trouble));
                }
                self.reset(Action::Renew(image));
            }
            _ => self.download(own, image),
        }
        self.actions.extend(self.random.chance(20).then_some(Action::Supply));
    }

    /// The work is done, or a part of it.
    fn run(&mut self) {
        let is_all = self.random.chance(70);
        let run = if is_all { Action::Settle } else { Action::Run(self.random.below(60) as u32) };
        self.actions.push(run);
    }

    /// After this action the device may have forgotten the password.
    fn reset(&mut self, action: Action) {
        self.actions.push(action);
        self.is_locked = true;
    }

    /// A flaw in a transfer, with this probability in percent.
    fn flaw(&mut self, percent: usize) -> Flaw {
        let (layout, random) = (self.setup.layout, &mut self.random);
        let region = random.pick(layout.programs);
        let ends = [region.base, region.base - 4, region.end() - 8, region.end(), 0xFFFF_FFF0];
        let addresses = [&ends[..], &[layout.bootloader.base, layout.parameters[0].base]].concat();
        if !random.chance(percent) {
            return Flaw::None;
        }
        let mut changes: Changes = [(0, 0); 3];
        let count = if self.setup.takes_sealed { 14 } else { 9 };
        match random.below(count) {
            0 => Flaw::Bit(random.below(20_000)),
            1 => Flaw::Crc,
            2 => Flaw::Address(random.pick(&addresses)),
            3 => Flaw::Product,
            4 => Flaw::Long(1 + random.below(600)),
            5 => Flaw::Number(random.pick(&[0, 1, 2, 5, u32::MAX])),
            6 => Flaw::Sum,
            9 => Flaw::Unsealed,
            10 => Flaw::Chunk(random.below(8), random.chance(50)),
            11 => Flaw::Head(random.below(RELEASES.len()) as u8),
            12 => Flaw::Stranger,
            13 => {
                changes.fill_with(|| (random.below(2000) as u16, random.below(256) as u8));
                Flaw::Signed(changes, random.chance(50))
            }
            _ => Flaw::Short(1 + random.below(999)),
        }
    }

    fn send(&mut self, sub: u8, content: Content, part: Part, flawed: usize) {
        let (is_announced, is_whole) = (self.random.chance(50), self.random.chance(90));
        let bytes = (!is_whole).then(|| self.random.below(600));
        let sent = Sent { content, part, flaw: self.flaw(flawed) };
        self.actions.push(Action::Send { sub, sent, is_announced, bytes });
        self.run();
        if !is_whole {
            let more = self.random.below(400);
            let end = self.random.pick(&[Action::GoOn(None), Action::GoOn(None), Action::Cancel]);
            self.actions.extend([Action::GoOn(Some(more)), Action::Run(20), end]);
            self.run();
        }
    }

    /// All blocks of a file, or a few that nobody has announced; or one transfer. Then a command.
    fn download(&mut self, sub: u8, content: Content) {
        let asks = std::mem::take(&mut self.is_locked) || self.random.chance(10);
        self.actions.extend(asks.then_some(Action::Password { sub, is_right: true }));
        self.actions.extend(self.random.chance(50).then_some(Action::Command { sub, value: CLEAR }));
        let blocks = file(self.setup, content).blocks.len();
        let from = if self.random.chance(80) { 0 } else { self.random.below(blocks) };
        let mut parts: Vec<_> = (from..blocks).map(Part::Block).collect();
        if self.setup.has(sub) && self.random.chance(40) {
            parts = vec![self.random.pick(&[Part::Whole, Part::Hex])];
        }
        let (ends, flawed) = self.random.pick(&[(1, 0), (1, 20), (30, 0), (50, 5)]);
        for part in parts {
            self.send(sub, content, part, flawed);
            if self.random.chance(ends) {
                return;
            }
        }
        if self.random.chance(50) {
            let value = self.random.pick(&[CONFIRM, START, 2]);
            self.actions.extend([Action::Settle, Action::Command { sub, value }]);
        }
    }

    /// A master goes on with what it has begun, or begins it again, whatever came in between.
    fn go_on(&mut self) {
        let sent = |action: &Action| match *action {
            Action::Send {
                sub, sent: Sent { content, part: Part::Block(block), .. }, bytes: None, ..
            } => Some((sub, content, block)),
            _ => None,
        };
        let mut begun: Vec<_> = self.actions.iter().rev().filter_map(sent).take(40).collect();
        begun.dedup_by_key(|(sub, content, _)| (*sub, *content));
        if begun.is_empty() {
            return;
        }
        let (sub, mut content, block) = self.random.pick(&begun);
        if let Content::Program(_, extent) = &mut content {
            *extent = self.random.pick(&[*extent, Extent::Large]);
        }
        let from = self.random.pick(&[0, 0, block + 1]);
        for block in from..=from + self.random.pick(&[1, 2, 14]) {
            self.send(sub, content, Part::Block(block), 5);
        }
    }
}

/// The whole download of a tool.
pub(crate) fn whole(setup: &'static Setup, sub: u8, content: Content) -> Vec<Action> {
    let mut actions = vec![Action::Settle, Action::Command { sub, value: CLEAR }];
    let blocks = if setup.takes_sealed { 0 } else { file(setup, content).blocks.len() };
    let parts = (0..blocks).map(Part::Block).chain(setup.takes_sealed.then_some(Part::Whole));
    actions.extend(parts.flat_map(|part| [Action::Settle, Action::send(sub, content, part)]));
    actions.push(Action::Settle);
    actions
}

/// What a tool does next so that this image becomes the bootloader. It has given the password.
pub(crate) fn renewal(seen: &Observation, setup: &'static Setup, image: Content) -> Vec<Action> {
    let sub = setup.profile.extras.bootloader.expect("it can be renewed");
    let wanted = Some(file(setup, image).crc);
    let is_ready = seen.is_staged && seen.record.map(|record| record.crc) == wanted;
    let value = match (seen.state(), seen.origin) {
        (State::Staged, Origin::Trial) | (State::Confirmed, _) => CONFIRM,
        (State::Staged, _) if is_ready => START,
        (_, Origin::Home) if seen.home != wanted => return whole(setup, sub, image),
        _ => return vec![Action::PowerOff],
    };
    vec![Action::Command { sub, value }, Action::Settle]
}

/// What a tool does so that no program reaches into staging: it erases it, or replaces it by a small one.
pub(crate) fn make_room(setup: &'static Setup) -> Vec<Action> {
    let sub = setup.programs();
    let mut actions = vec![Action::PowerOff, Action::Settle, Action::Password { sub, is_right: true }];
    if setup.takes_sealed {
        actions.extend(whole(setup, sub, Content::Program(sub, Extent::Small)));
    } else {
        actions.extend([Action::Settle].into_iter().chain([Action::Command { sub, value: CLEAR }; 2]));
    }
    actions
}

/// What a tool does so that this program is installed in this form, and starts. Work comes after each.
pub(crate) fn installation(setup: &'static Setup, sub: u8, part: Part) -> Vec<Action> {
    let content = Content::Program(sub, Extent::Small);
    let mut actions = vec![match setup.password(sub) {
        Some(_) => Action::Password { sub, is_right: true },
        None => Action::Command { sub, value: CLEAR },
    }];
    let is_block = part == Part::Block(0);
    let blocks = if is_block { file(setup, content).blocks.len() } else { 1 };
    let parts = (0..blocks).map(|block| if is_block { Part::Block(block) } else { part });
    actions.extend(parts.map(|part| Action::send(sub, content, part)));
    let is_done = setup.is_data(sub) || setup.profile.download.starts_by_itself && !is_block;
    let value = [CONFIRM, START];
    let commands = if is_done { &value[..0] } else { &value[usize::from(!is_block)..] };
    actions.extend(commands.iter().map(|value| Action::Command { sub, value: *value }));
    actions
}
