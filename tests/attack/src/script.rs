//! The actions of an attack.

use boot_core::flash::FlashFault;
use kit::bench::{CLEAR, SET_SIGNATURE as CONFIRM, START};
use kit::model::Cut;
use kit::random::Random;
use kit::rig::{crc32, Setup};
use shared_abi::renewal::{Origin, State};

use crate::device::{Action, Seen, Trouble};
use crate::files::{file, Content, Extent};

/// Commands of 1F51h.
const COMMANDS: [u8; 9] = [0, START, 2, CLEAR, CLEAR, 0x80, CONFIRM, CONFIRM, 0x84];
const IMAGES: [u8; 6] = [1, 1, 2, 2, 4, 5];
const EXTENTS: [Extent; 4] = [Extent::Small, Extent::Small, Extent::Large, Extent::Untold];

/// The kinds of actions. The last two, which a renewal needs, are in each attack.
const KINDS: usize = 18;

/// The program number of the bootloader.
pub(crate) fn bootloader(setup: &Setup) -> u8 {
    setup.profile.extras.bootloader.unwrap_or(0)
}

struct Script {
    setup: &'static Setup,
    random: Random,
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
    let mut script = Script { setup, random, actions: Vec::new(), is_locked: true };
    for _ in 0..script.random.below(60) {
        let kind = script.random.pick(&kinds);
        script.draw(kind);
        script.run();
    }
    script.actions
}

impl Script {
    fn draw(&mut self, kind: usize) {
        let own = bootloader(self.setup);
        let random = &mut self.random;
        let program = 1 + random.below(self.setup.programs().into()) as u8;
        let of_program = Content::Program(program, random.pick(&EXTENTS));
        let image = Content::Image(random.pick(&IMAGES));
        let any = 1 + random.below(4) as u8;
        let sub = random.pick(&[program, program, own, own, any]);
        let far = random.pick(&[25, 80, 300]);
        let after = 1 + random.below(far) as u32;
        let seed = random.next();
        let cut = random.pick(&[Cut::Before, Cut::After, Cut::Torn(seed), Cut::Unstable(seed)]);
        let fails = Trouble::Fail(FlashFault::Failed);
        match kind {
            0 | 1 => {
                let value = if random.chance(95) { random.pick(&COMMANDS) } else { seed as u8 };
                self.actions.push(Action::Command { sub, value });
            }
            2 => self.actions.push(Action::Password { sub }),
            3 | 4 => self.download(own, image),
            5 | 6 => self.download(program, of_program),
            7 => {
                // Of one of two masters, which may not end it.
                let content = random.pick(&[of_program, image]);
                let block = random.chance(60).then(|| random.below(3));
                let bytes = random.chance(60).then(|| random.below(1500));
                self.actions.push(Action::Send { sub, content, block, bytes });
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
            16 => self.go_on(),
            _ => {
                let image = if seed.is_multiple_of(4) { image } else { Content::Image(1) };
                self.actions.extend(self.is_locked.then_some(Action::Password { sub: own }));
                if self.random.chance(40) {
                    let trouble = self.random.pick(&[Trouble::Dip, fails]);
                    self.actions.push(Action::Flash(after, trouble));
                }
                self.reset(Action::Renew(image));
            }
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

    fn send(&mut self, sub: u8, content: Content, block: usize) {
        self.actions.push(Action::Send { sub, content, block: Some(block), bytes: None });
        self.run();
    }

    /// All blocks of a file, or a few that nobody has announced.
    fn download(&mut self, sub: u8, content: Content) {
        let asks = std::mem::take(&mut self.is_locked) || self.random.chance(10);
        self.actions.extend(asks.then_some(Action::Password { sub }));
        self.actions.extend(self.random.chance(50).then_some(Action::Command { sub, value: CLEAR }));
        let blocks = file(self.setup, content).blocks.len();
        let from = if self.random.chance(80) { 0 } else { self.random.below(blocks) };
        let ends = self.random.pick(&[1, 30, 50]);
        for block in from..blocks {
            self.send(sub, content, block);
            if self.random.chance(ends) {
                break;
            }
        }
    }

    /// A master goes on with what it has begun, or begins it again, whatever came in between.
    fn go_on(&mut self) {
        let sent = |action: &Action| match *action {
            Action::Send { sub, content, block: Some(block), bytes: None } => Some((sub, content, block)),
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
            self.send(sub, content, block);
        }
    }
}

/// The whole download of a tool.
fn whole(setup: &'static Setup, sub: u8, content: Content) -> Vec<Action> {
    let mut actions = vec![Action::Settle, Action::Command { sub, value: CLEAR }];
    for block in 0..file(setup, content).blocks.len() {
        actions.extend([Action::Settle, Action::Send { sub, content, block: Some(block), bytes: None }]);
    }
    actions.push(Action::Settle);
    actions
}

/// What a tool does next so that this image becomes the bootloader. It has given the password.
pub(crate) fn renewal(seen: &Seen, setup: &'static Setup, image: Content) -> Vec<Action> {
    let sub = bootloader(setup);
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
    let mut actions = vec![Action::PowerOff, Action::Settle, Action::Password { sub }];
    if setup.takes_sealed {
        actions.extend(whole(setup, sub, Content::Program(sub, Extent::Small)));
    } else {
        actions.extend([Action::Settle].into_iter().chain([Action::Command { sub, value: CLEAR }; 2]));
    }
    actions
}
