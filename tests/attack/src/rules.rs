//! The rules that a device keeps.

use std::collections::BTreeSet;

use boot_core::policy::Erase;
use boot_core::store::NodeParameters;
use canopen::{AbortCode, BitRate, NodeId};
use kit::bench::{CLEAR, CLR_SIGNATURE, SET_SIGNATURE, START};
use kit::rig::{crc32, Setup};
use seal::access::right;
use shared_abi::renewal::{Origin, State};
use shared_abi::warm_start::BootRequest;

use crate::device::{Action, Holder, Observation, Partial, Program, Stored, Trouble};
use crate::files::{counter_of_image, file, may_run, Content, Flaw, Part, Sent};

/// What was before an action, and the action with its answer.
#[derive(Clone)]
pub struct History {
    setup: &'static Setup,
    action: Action,
    answer: Result<(), AbortCode>,
    /// The device then.
    pub seen: Observation,
    /// The programs, number 1 first: whether this one may be lost since CLEAR or data were accepted.
    may_go: Vec<bool>,
    /// The image in staging has decayed since it was stored.
    rotten: bool,
    /// The sub-index of the last transfer, and whether it is one of all data.
    sub: u8,
    is_stream: bool,
    /// The sub-indices whose CLEAR was acknowledged: a second one erases.
    cleared: BTreeSet<u8>,
    /// The sub-indices whose password was given since the last reset.
    unlocked: BTreeSet<u8>,
    /// The sub-indices that may be released by what was done.
    released: BTreeSet<u8>,
    /// A root has permitted to erase since the last reset.
    may_erase: bool,
    /// The content that a begun download of a program may name in 2006h; `None` since something
    /// else came.
    begun: Vec<(u8, Option<Content>)>,
    /// The highest security counter of a program that is there and counts, by program.
    proved: Vec<u32>,
    /// The same, and of a program that may have proved itself before a cut.
    may_be_proved: Vec<u32>,
    /// An owner has signed what he should not have.
    pub(crate) is_spoilt: bool,
    /// The sub-indices that an action has named since there was no work: these alone may change.
    named: BTreeSet<u8>,
    /// Those that were to be started since the last reset.
    asked: BTreeSet<u8>,
    /// START of it was acknowledged, and nothing else was asked.
    started: Option<u8>,
    /// The programs that were sent: by number, CRC, and security counter.
    sent: Vec<(u8, u32, u32)>,
    /// The values that LSS may have stored: after a cut a record may read as it likes.
    nodes: Vec<NodeParameters>,
    /// The last of them was acknowledged.
    stores: bool,
}

impl History {
    pub(crate) fn new(setup: &'static Setup, seen: Observation) -> Self {
        Self {
            setup,
            action: Action::Settle,
            answer: Ok(()),
            may_go: vec![false; seen.programs.len()],
            rotten: false,
            sub: 1,
            is_stream: false,
            cleared: BTreeSet::new(),
            unlocked: BTreeSet::new(),
            released: BTreeSet::new(),
            may_erase: false,
            begun: Vec::new(),
            proved: vec![0; seen.programs.len()],
            may_be_proved: vec![0; seen.programs.len()],
            is_spoilt: false,
            named: BTreeSet::new(),
            asked: BTreeSet::new(),
            started: None,
            sent: (1..)
                .zip(&seen.programs)
                .filter_map(|(n, is)| Some((n, is.record?.crc, is.counter)))
                .collect(),
            nodes: vec![seen.node],
            stores: false,
            seen,
        }
    }

    /// Takes note of an action and of its answer.
    pub(crate) fn note(&mut self, action: &Action, answer: Result<(), AbortCode>) {
        (self.action, self.answer) = (*action, answer);
        let (setup, is_taken) = (self.setup, answer.is_ok());
        if !matches!(action, Action::Run(_) | Action::Settle | Action::Read { .. } | Action::Wait(_)) {
            self.started = None;
        }
        match *action {
            Action::Command { sub, value } if is_taken => {
                if matches!(value, CLEAR | SET_SIGNATURE | CLR_SIGNATURE) {
                    self.named.insert(sub);
                }
                // CLEAR alone loses nothing; in a sealed device only with the right to erase.
                let is_second = value == CLEAR && !self.cleared.insert(sub);
                let erases = is_second || (setup.profile.download.erase)(sub) == Erase::AtOnce;
                let may_erase = !setup.takes_sealed || self.may_erase;
                self.may_lose(sub, value == CLEAR && erases && may_erase);
                if value == SET_SIGNATURE {
                    self.released.insert(sub);
                }
                // In CiA 302-3, 2 means reset, which starts the program for some profiles and after a stream.
                if matches!(value, START | 2) {
                    self.asked.insert(sub);
                }
                self.started = (value == START && setup.has(sub)).then_some(sub);
            }
            Action::Password { sub, .. } if is_taken => {
                self.unlocked.insert(sub);
                if setup.password_clears() {
                    self.named.insert(sub);
                    self.may_lose(sub, !setup.takes_sealed || self.may_erase);
                } else {
                    self.unlocked.extend(1..=u8::MAX);
                }
            }
            Action::Right(_, right::ERASE) if is_taken => self.may_erase = true,
            Action::Return(sub) => drop((self.named.insert(sub), self.released.insert(sub))),
            Action::Flash(_, Trouble::Weak(_)) => self.begun.iter_mut().for_each(|(_, begun)| *begun = None),
            Action::Send { sub, sent, .. } => {
                self.sub = sub;
                self.is_spoilt |= matches!(sent.flaw, Flaw::Signed(..));
                if sent.completes(setup, sub) {
                    self.sent.push((sub, sent.crc(setup, sub), sent.content.counter()));
                }
                self.is_stream = sent.is_stream(setup, sub) || setup.takes_sealed;
                self.begin(sub, sent);
                // Of a stream the first part may have been accepted.
                let is_accepted = sent.is_stream(setup, sub) || sent.part != Part::Block(0) && is_taken;
                // A counter is judged before anything is lost.
                let proved = self.proved.get(usize::from(sub).wrapping_sub(1)).copied().unwrap_or(0);
                let is_older = setup.takes_sealed && sent.content.counter() < proved;
                self.may_lose(sub, is_accepted && sent.fits(setup, sub) && !is_older);
            }
            Action::Store(id) if is_taken => {
                self.stores = true;
                self.nodes.push(NodeParameters { id: NodeId::new(id), bit_rate: BitRate::K250 });
            }
            Action::Rot(..) => self.rotten = true,
            _ => {}
        }
        if matches!(action, Action::Send { .. } | Action::GoOn(_)) {
            self.named.insert(self.sub);
            self.released.extend(self.is_stream.then_some(self.sub));
            if is_taken && setup.profile.download.starts_by_itself {
                self.asked.insert(self.sub);
            }
        }
    }

    /// What 2006h may name: the content whose block 0 came, if no other content came for this
    /// program.
    fn begin(&mut self, sub: u8, sent: Sent) {
        let is_pure =
            matches!(sent.part, Part::Block(_)) && sent.flaw == Flaw::None && !self.setup.takes_sealed;
        match self.begun.iter_mut().find(|(of, _)| *of == sub) {
            Some((_, begun)) if is_pure && *begun == Some(sent.content) => {}
            Some((_, begun)) => *begun = None,
            None => self.begun.push((sub, is_pure.then_some(sent.content))),
        }
    }

    /// This program may be lost now.
    fn may_lose(&mut self, sub: u8, is_so: bool) {
        if let Some(may_go) = self.may_go.get_mut(usize::from(sub).wrapping_sub(1)) {
            *may_go |= is_so;
        }
    }

    pub(crate) fn update(&mut self, seen: Observation) {
        self.rotten &= seen.record.is_some();
        let is_reset = seen.starts != self.seen.starts;
        let counters: Vec<_> =
            (1..).zip(&seen.programs).map(|(number, program)| counter_of(self, number, program)).collect();
        for ((proved, counter), program) in self.may_be_proved.iter_mut().zip(&counters).zip(&seen.programs) {
            let is_proved = program.record.is_some_and(|record| record.confirmed);
            *proved = (*proved).max(if is_proved { *counter } else { program.counter });
        }
        for ((proved, counter), program) in self.proved.iter_mut().zip(counters).zip(&seen.programs) {
            let Some(record) = program.record.filter(|_| seen.is_certain) else { continue };
            let counts = record.confirmed || !self.setup.config.download.seal.counter_with_confirmation;
            if counts {
                *proved = (*proved).max(counter);
            }
        }
        for ((may_go, now), before) in self.may_go.iter_mut().zip(&seen.programs).zip(&self.seen.programs) {
            // What was accepted belongs to a session; and a new program begins without.
            let is_over = is_reset || now.stored != before.stored;
            *may_go &= !(is_over && matches!(now.stored, Stored::Good(_)));
        }
        let programs = (1..).zip(self.seen.programs.iter().zip(&seen.programs));
        let is_new = |(_, (before, now)): &(u8, (&Program, &Program))| now.stored != before.stored;
        let new: Vec<u8> = programs.filter(is_new).map(|(number, _)| number).collect();
        self.cleared.retain(|number| !new.contains(number));
        if is_reset {
            self.cleared.clear();
            self.asked.clear();
            self.unlocked.clear();
            (self.started, self.stores, self.may_erase) = (None, false, false);
        }
        if seen.is_idle {
            self.named.clear();
            self.released.clear();
            if self.stores && seen.is_stored {
                self.nodes = vec![seen.node];
            }
            self.stores = false;
        }
        self.seen = seen;
    }
}

/// What is true after each action.
pub struct Rule {
    pub name: &'static str,
    pub is_kept: fn(before: &History, now: &Observation) -> bool,
}

const fn rule(name: &'static str, is_kept: fn(&History, &Observation) -> bool) -> Rule {
    Rule { name, is_kept }
}

pub const RULES: &[Rule] = &[
    rule("a bootloader can be loaded after each reset", loads),
    rule("the installation alone removes a confirmed record", keeps_confirmed),
    rule("data are not changed while a record for them is valid", records_are_true),
    rule("a program is lost by CLEAR or by accepted data alone", keeps_programs),
    rule("a program has the CRC that is told, and was sent with it", tells_the_truth),
    rule("the journal and what an action names alone are erased or written", touches_the_named),
    rule("records that no action names and what LSS stored stay", others_stay),
    rule("what starts is what was asked for", starts_what_was_asked),
    rule("values and aborts are those of the standards", has_defined_values),
    rule("without work no program is busy", ends),
    rule("what starts by itself is whole and released", starts_the_whole),
    rule("a program is released by 83h or by a transfer of all of it", releases),
    rule("without the password nothing is taken", is_locked),
    rule("data up to the address in 2006h are in flash", goes_on),
    rule("a sealed device has sealed programs alone", is_sealed),
    rule("no security counter decreases", counts),
    rule("no program is there before its security counter", is_counted),
    rule("no program follows a proved one with a higher counter", follows),
    rule("with confirmation a counter waits for it", waits),
    rule("a sealed bootloader follows one with a lower counter", follows_home),
    rule("2007h/2 is what a power-on does, and 2007h/12 is what is released", says_what_is),
];

/// The first rule that is broken.
pub fn broken(before: &History, now: &Observation) -> Option<&'static Rule> {
    RULES.iter().find(|rule| !(rule.is_kept)(before, now))
}

/// Errors in 1F57h (SYS TEC manual L-1112d_10, table 3), and the three of sealed images (docs/protocol.md).
#[rustfmt::skip]
const ERRORS: [u32; 18] = [
    0x00, 0x02, 0x04, 0x06, 0x08, 0x0A, 0x0C, 0x0E, 0x10, 0x7E, 0x80, 0x82, 0x84, 0x86, 0x88,
    0x8A, 0x8C, 0x8E,
];
/// Aborts (CiA 301 table 22).
#[rustfmt::skip]
const ABORTS: [u32; 31] = [
    0x0503_0000, 0x0504_0000, 0x0504_0001, 0x0504_0002, 0x0504_0003, 0x0504_0004, 0x0504_0005, 0x0601_0000,
    0x0601_0001, 0x0601_0002, 0x0602_0000, 0x0604_0041, 0x0604_0042, 0x0604_0043, 0x0604_0047, 0x0606_0000,
    0x0607_0010, 0x0607_0012, 0x0607_0013, 0x0609_0011, 0x0609_0030, 0x0609_0031, 0x0609_0032, 0x0609_0036,
    0x060A_0023, 0x0800_0000, 0x0800_0020, 0x0800_0021, 0x0800_0022, 0x0800_0023, 0x0800_0024,
];

fn loads(before: &History, now: &Observation) -> bool {
    let renews = before.setup.profile.extras.bootloader.is_some();
    !renews || now.loads.is_some_and(|crc| may_run(before.setup, crc))
}

fn keeps_confirmed(before: &History, now: &Observation) -> bool {
    let was = &before.seen;
    let Some(record) = was.record.filter(|record| record.state == State::Confirmed) else { return true };
    // The resident part has loaded home all the same: the record is void.
    let is_void = was.origin == Origin::Home;
    let is_installed = now.state() == State::Installed && now.home == Some(record.crc);
    let is_certain = was.is_certain && now.is_certain;
    now.record == Some(record) || is_installed || is_void || !is_certain
}

fn records_are_true(before: &History, now: &Observation) -> bool {
    let is_true = now.record.is_none() || now.is_staged || before.rotten || !now.is_certain;
    is_true && now.programs.iter().all(|program| program.stored != Stored::Damaged)
}

fn keeps_programs(before: &History, now: &Observation) -> bool {
    let was = &before.seen;
    let mut programs = was.programs.iter().zip(&now.programs).zip(&before.may_go);
    let is_certain = was.is_certain && now.is_certain;
    !is_certain
        || programs.all(|((was, now), may_go)| {
            *may_go || now.stored == was.stored || !matches!(was.stored, Stored::Good(_))
        })
}

fn tells_the_truth(before: &History, now: &Observation) -> bool {
    let read_back = match before.action {
        Action::Upload { sub } => now.read_back.zip(now.program(sub)),
        _ => None,
    };
    let is_sent = |(number, program): (u8, &Program)| {
        let is = |sent: &(u8, u32, u32), crc| (sent.0, sent.1) == (number, crc);
        program.record.is_none_or(|record| before.sent.iter().any(|sent| is(sent, record.crc)))
    };
    now.programs.iter().all(|program| program.is_true)
        && (1..).zip(&now.programs).all(is_sent)
        && read_back.is_none_or(|(crc, program)| crc == program.crc)
}

fn touches_the_named(before: &History, now: &Observation) -> bool {
    let (setup, layout) = (before.setup, before.setup.layout);
    let named = before.named.iter().filter(|sub| setup.has(**sub)).map(|sub| setup.region(*sub));
    // A renewal goes on after a reset, and what takes its place ends it.
    let own = setup.profile.extras.bootloader;
    let renews = own.is_some_and(|own| before.named.contains(&own)) || before.seen.state() != State::None;
    let of_renewal = layout.home.into_iter().chain(layout.staging).filter(|_| renews);
    let places: Vec<_> = named.chain(of_renewal).chain(layout.parameters).collect();
    now.touched.iter().all(|at| places.iter().any(|place| place.contains(at.base, at.size)))
}

fn others_stay(before: &History, now: &Observation) -> bool {
    // A record with bits between 0 and 1 reads as it likes, and its data are checked by other rules.
    let mut programs = (1..).zip(before.seen.programs.iter().zip(&now.programs));
    let last = before.nodes.last().filter(|_| before.stores && now.is_idle && now.is_stored);
    let is_certain = before.seen.is_certain && now.is_certain;
    programs
        .all(|(number, (was, now))| was.record == now.record || before.named.contains(&number) || !is_certain)
        && before.nodes.contains(&now.node)
        && last.is_none_or(|last| *last == now.node)
}

fn starts_what_was_asked(before: &History, now: &Observation) -> bool {
    use BootRequest::{Fresh, Renewal, Start, Trial};
    let waits = before.started.filter(|_| now.is_idle).and_then(|started| now.program(started));
    let Some(request) = now.request else { return waits.is_none_or(|program| program.status != 0) };
    let (Start(number) | Trial(number) | Fresh(number)) = request else {
        return matches!(request, Renewal(_)) && before.setup.profile.extras.bootloader.is_some();
    };
    let record = now.program(number).and_then(|program| program.record);
    // After a download in one transfer it is released or on trial.
    let fits = |signed| matches!(request, Fresh(_)) || signed == matches!(request, Start(_));
    (record.is_some_and(|record| fits(record.signed)) || !now.is_certain)
        && before.asked.contains(&number)
        && !before.setup.is_data(number)
}

fn has_defined_values(before: &History, now: &Observation) -> bool {
    let has_password = |sub| before.setup.password(sub).is_some();
    let is_wrong = match before.action {
        Action::Password { sub, is_right: false } => has_password(sub),
        Action::Right(holder, _) => holder != Holder::Root,
        _ => false,
    };
    let is_defined = |program: &Program| {
        let Program { state, status, .. } = *program;
        let errors = if before.setup.takes_sealed { &ERRORS[..] } else { &ERRORS[..15] };
        [0, 3].contains(&state) && status & 0xFF00 == 0 && errors.contains(&(status & 0xFE))
    };
    before.answer.map_or_else(|abort| ABORTS.contains(&abort.0), |()| !is_wrong)
        && now.programs.iter().all(is_defined)
}

fn ends(_: &History, now: &Observation) -> bool {
    !now.is_idle || now.programs.iter().all(|program| program.status & 1 == 0)
}

fn starts_the_whole(_: &History, now: &Observation) -> bool {
    now.starting.is_none_or(|(_, is_whole)| is_whole)
}

fn releases(before: &History, now: &Observation) -> bool {
    let is_signed = |program: &Program| program.record.is_some_and(|record| record.signed);
    let is_certain = before.seen.is_certain && now.is_certain;
    let mut programs = (1..).zip(before.seen.programs.iter().zip(&now.programs));
    let may_be = |number| before.released.contains(&number) || before.asked.contains(&number);
    !is_certain || programs.all(|(number, (was, now))| !is_signed(now) || is_signed(was) || may_be(number))
}

fn is_locked(before: &History, _: &Observation) -> bool {
    let Action::Send { sub, .. } = before.action else { return true };
    before.answer.is_err() || !before.setup.profile.download.locked || before.unlocked.contains(&sub)
}

fn goes_on(before: &History, now: &Observation) -> bool {
    (1..).zip(&now.programs).all(|(number, program)| {
        let Some(Partial { id, len, crc }) = program.partial else { return true };
        let begun = before.begun.iter().find(|(of, _)| *of == number).and_then(|(_, begun)| *begun);
        let Some(content) = begun else { return true };
        let file = file(before.setup, content);
        let control = &file.blocks[0];
        let is_its = control[control.len() - 4..] == id.to_le_bytes();
        !is_its || file.plain.get(..len).is_some_and(|done| crc32(done) == crc)
    })
}

fn is_sealed(before: &History, now: &Observation) -> bool {
    let is_sealed = |program: &Program| program.record.is_none_or(|record| record.is_sealed());
    !before.setup.takes_sealed || now.programs.iter().all(is_sealed)
}

fn counts(before: &History, now: &Observation) -> bool {
    let is_certain = before.seen.is_certain && now.is_certain;
    !is_certain || before.seen.programs.iter().zip(&now.programs).all(|(was, now)| now.counter >= was.counter)
}

/// The lowest security counter of the program that is there, by its CRC; 0 for none.
fn counter_of(before: &History, number: u8, program: &Program) -> u32 {
    let Some(record) = program.record.filter(|_| before.setup.takes_sealed) else { return 0 };
    let sent = before.sent.iter().filter(|(of, crc, _)| (*of, *crc) == (number, record.crc));
    sent.map(|(.., counter)| *counter).min().unwrap_or(0)
}

fn is_counted(before: &History, now: &Observation) -> bool {
    before.setup.config.download.seal.counter_with_confirmation
        || (1..)
            .zip(&now.programs)
            .all(|(number, program)| program.counter >= counter_of(before, number, program))
}

fn follows(before: &History, now: &Observation) -> bool {
    let is_certain = before.seen.is_certain && now.is_certain;
    let programs = (1..).zip(before.seen.programs.iter().zip(&now.programs));
    !is_certain
        || programs.zip(&before.proved).all(|((number, (was, now)), proved)| {
            was.stored == now.stored || now.record.is_none() || counter_of(before, number, now) >= *proved
        })
}

/// Two genuine bootloaders cannot be exchanged for ever.
fn follows_home(before: &History, now: &Observation) -> bool {
    let (setup, was) = (before.setup, &before.seen);
    let is_certain = was.is_certain && now.is_certain && !before.is_spoilt;
    let is_new = |crc: &u32| was.record.map(|record| record.crc) != Some(*crc);
    let staged = now.record.filter(|_| now.is_staged).map(|record| record.crc).filter(is_new);
    let counter = |crc| counter_of_image(setup, crc);
    let follows = |(staged, home)| counter(staged) > counter(home);
    !setup.takes_sealed || !is_certain || staged.zip(was.home).is_none_or(follows)
}

fn says_what_is(before: &History, now: &Observation) -> bool {
    let same = |[said, is]: [u32; 2]| said == is;
    // The boot stage of this device takes data for a program.
    let has_data = before.setup.profile.download.data.is_some();
    !now.is_idle || !now.is_certain || (has_data || same(now.stays)) && same(now.released)
}

fn waits(before: &History, now: &Observation) -> bool {
    let is_certain = before.seen.is_certain && now.is_certain && !before.is_spoilt;
    let with_confirmation = before.setup.config.download.seal.counter_with_confirmation;
    let mut programs = (1..).zip(&now.programs).zip(&before.may_be_proved);
    !with_confirmation
        || !is_certain
        || programs.all(|((number, program), proved)| {
            let is_proved = program.record.is_some_and(|record| record.confirmed);
            let own = if is_proved { counter_of(before, number, program) } else { 0 };
            program.counter <= own.max(*proved)
        })
}
