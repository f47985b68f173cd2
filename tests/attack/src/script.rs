//! The actions of an attack.

use boot_core::flash::FlashFault;
use kit::model::Cut;
use kit::random::Random;
use kit::rig::Setup;
use shared_abi::renewal::{Origin, State};

use crate::device::{Action, Seen};
use crate::files::{crc, file, Content, Extent};

/// Commands of 1F51h.
pub const CLEAR: u8 = 3;
const START: u8 = 1;
const CONFIRM: u8 = 0x83;
const COMMANDS: [u8; 9] = [0, START, 2, CLEAR, CLEAR, 0x80, CONFIRM, CONFIRM, 0x84];

/// The program number of the bootloader.
pub(crate) fn bootloader(setup: &Setup) -> u8 {
    setup.profile.extras.bootloader.unwrap_or(0)
}

/// The actions of a seed.
pub fn of(setup: &'static Setup, seed: u64) -> Vec<Action> {
    // Each product has its own attacks.
    let mut random = Random(seed ^ u64::from(kit::rig::crc32(setup.name.as_bytes())) << 32);
    // Some kinds of actions alone, each time others: what one kind needs, another one always undoes.
    let kinds: Vec<usize> =
        (0..KINDS).filter(|_| random.chance(40)).chain([KINDS - 2, KINDS - 1, KINDS - 1]).collect();
    let mut script = Script { setup, random, actions: Vec::new(), is_locked: true };
    for _ in 0..script.random.below(60) {
        let kind = script.random.pick(&kinds);
        script.draw(kind);
        script.run();
    }
    script.actions
}

struct Script {
    setup: &'static Setup,
    random: Random,
    actions: Vec<Action>,
    /// A reset may have come since the last password.
    is_locked: bool,
}

const EXTENTS: [Extent; 4] = [Extent::Small, Extent::Small, Extent::Large, Extent::Untold];

/// The kinds of actions; a tool is the last one.
const KINDS: usize = 20;

impl Script {
    fn add(&mut self, action: Action) {
        self.actions.push(action);
    }

    /// The work is done, or a part of it.
    fn run(&mut self) {
        let is_all = self.random.chance(70);
        let run = if is_all { Action::Settle } else { Action::Run(self.random.below(60) as u32) };
        self.add(run);
    }

    fn draw(&mut self, kind: usize) {
        let own = bootloader(self.setup);
        let random = &mut self.random;
        let program = 1 + random.below(self.setup.programs().into()) as u8;
        let of_program = Content::Program { number: program, extent: random.pick(&EXTENTS) };
        let any = 1 + random.below(4) as u8;
        let sub = random.pick(&[program, program, own, own, any]);
        let far = random.pick(&[25, 80, 300]);
        let after = 1 + random.below(far) as u32;
        let seed = random.next();
        match kind {
            0 | 1 => {
                let value = if random.chance(95) { random.pick(&COMMANDS) } else { seed as u8 };
                self.add(Action::Command { sub, value });
            }
            2 => self.add(Action::Password { sub }),
            3 | 4 => {
                let image = random.pick(&Content::SENT);
                self.download(own, image);
            }
            5 | 6 => self.download(program, of_program),
            7 => {
                // Of one of two masters, which does not end it.
                let content = random.pick(&[of_program, Content::Image(1)]);
                let block = random.chance(60).then(|| random.below(3));
                let bytes = random.chance(60).then(|| random.below(1500));
                self.add(Action::Send { sub, content, block, bytes });
                if seed % 3 == 0 {
                    self.add(Action::Cancel);
                }
            }
            8 => {
                let ms = random.pick(&[1, 1000, 40_000, 60_000]);
                self.add(Action::Wait(ms));
            }
            9 => self.add(Action::Store(1 + (seed % 127) as u8)),
            10 => self.reset(Action::ResetNode),
            11 => self.reset(Action::PowerOff),
            12 => {
                let kinds = [Cut::Before, Cut::After, Cut::Torn(seed), Cut::Unstable(seed)];
                let cut = random.pick(&kinds);
                self.reset(Action::Cut(after, cut));
            }
            13 => self.add(Action::Dip(after)),
            14 => self.add(Action::Fail(after, FlashFault::Failed)),
            15 => self.add(Action::Weak(after, seed)),
            16 => self.reset(Action::Rot(seed as usize, (seed >> 32) as u8)),
            17 | 18 => self.go_on(),
            _ => {
                let image = if seed % 4 == 0 { random.pick(&Content::SENT) } else { Content::Image(1) };
                let disturbance = random.pick(&[Action::Dip(after), Action::Fail(after, FlashFault::Failed)]);
                if self.is_locked {
                    self.add(Action::Password { sub: own });
                }
                if self.random.chance(40) {
                    self.add(disturbance);
                }
                self.reset(Action::Renew(image));
            }
        }
        if self.random.chance(20) {
            self.add(Action::Supply);
        }
    }

    /// After this action the device may have forgotten the password.
    fn reset(&mut self, action: Action) {
        self.add(action);
        self.is_locked = true;
    }

    /// All blocks of a file, or a few that nobody has announced.
    fn download(&mut self, sub: u8, content: Content) {
        if core::mem::replace(&mut self.is_locked, false) || self.random.chance(10) {
            self.add(Action::Password { sub });
        }
        if self.random.chance(50) {
            self.add(Action::Command { sub, value: CLEAR });
        }
        let blocks = file(self.setup, content).blocks.len();
        let from = if self.random.chance(80) { 0 } else { self.random.below(blocks) };
        let ends = self.random.pick(&[1, 30, 50]);
        for block in from..blocks {
            self.add(Action::Send { sub, content, block: Some(block), bytes: None });
            self.run();
            if self.random.chance(ends) {
                break;
            }
        }
    }

    /// A master goes on with what it has begun, or begins it again, whatever came in between.
    fn go_on(&mut self) {
        let mut begun: Vec<_> = self
            .actions
            .iter()
            .rev()
            .filter_map(|action| match *action {
                Action::Send { sub, content, block: Some(block), bytes: None } => Some((sub, content, block)),
                _ => None,
            })
            .take(40)
            .collect();
        begun.dedup_by_key(|(sub, content, _)| (*sub, *content));
        let Some(last) = begun.len().checked_sub(1) else { return };
        let (sub, mut content, block) = begun[self.random.below(last + 1)];
        if let Content::Program { extent, .. } = &mut content {
            *extent = self.random.pick(&[*extent, Extent::Large]);
        }
        let from = self.random.pick(&[0, 0, block + 1]);
        for block in from..from + 1 + self.random.pick(&[1, 2, 14]) {
            self.add(Action::Send { sub, content, block: Some(block), bytes: None });
            self.run();
        }
    }
}

/// The whole download of a tool.
fn whole(setup: &'static Setup, sub: u8, content: Content) -> Vec<Action> {
    let blocks = 0..file(setup, content).blocks.len();
    let send = |block| Action::Send { sub, content, block: Some(block), bytes: None };
    let begin = [Action::Settle, Action::Command { sub, value: CLEAR }];
    begin
        .into_iter()
        .chain(blocks.flat_map(|block| [Action::Settle, send(block)]))
        .chain([Action::Settle])
        .collect()
}

/// What a tool does next so that this image becomes the bootloader. It has given the password.
pub(crate) fn renewal(seen: &Seen, setup: &'static Setup, image: Content) -> Vec<Action> {
    let sub = bootloader(setup);
    let wanted = crc(setup, image);
    let is_ready = seen.is_staged && seen.record.map(|record| record.crc) == wanted;
    let value = match (seen.record.map(|record| record.state), seen.origin) {
        (Some(State::Staged), Origin::Trial) | (Some(State::Confirmed), _) => CONFIRM,
        (Some(State::Staged), _) if is_ready => START,
        (_, Origin::Home) if seen.home != wanted => return whole(setup, sub, image),
        _ => return vec![Action::PowerOff],
    };
    vec![Action::Command { sub, value }, Action::Settle]
}

/// What a tool does so that no program reaches into staging: it erases it, or replaces it by a small one.
pub(crate) fn make_room(setup: &'static Setup) -> Vec<Action> {
    let sub = setup.programs();
    let mut actions = vec![Action::Settle, Action::Password { sub }];
    if setup.takes_sealed {
        actions.extend(whole(setup, sub, Content::Program { number: sub, extent: Extent::Small }));
    } else {
        actions.extend([
            Action::Settle,
            Action::Command { sub, value: CLEAR },
            Action::Command { sub, value: CLEAR },
        ]);
    }
    actions
}
