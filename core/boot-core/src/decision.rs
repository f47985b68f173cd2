//! The choice of the boot stage: what runs after a reset, made once before any peripheral is used.
//!
//! The order of the checks is a promise of the product (docs/architecture.md): requests for the
//! bootloader come first, so that no program, however broken, can keep a device in the application.

use core::ops::RangeInclusive;

use canopen::BitRate;
use shared_abi::boot_report::{BootReport, Reason};
use shared_abi::geometry::Region;
use shared_abi::handoff::ResetCause;
use shared_abi::layout::Layout;
use shared_abi::renewal::{word, Origin, State, TrialEnd};
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::{BootRequest, Damage, Owed, TrialStep};

use crate::crc::CrcKind;
use crate::flash::Flash;
use crate::program::{verify, Invalid, VerifiedProgram};
use crate::renewal::Places;
use crate::store::{Key, Parameters, RenewalRecord};

/// Everything that the boot stage reads once after a reset.
#[derive(Clone, Copy, Debug)]
pub struct Woken {
    /// The cause of the reset.
    pub cause: ResetCause,
    /// The request from the warm-start cell, which has been consumed.
    pub request: Option<BootRequest>,
    /// The cell had the mark of a [`PinReset::First`].
    pub is_marked: bool,
    /// The entry strap asks for the bootloader.
    pub strap: bool,
    /// The origin of the RAM image that this reset has ended; `None` if a program ran, if the power
    /// failed, or if the bootloader cannot be renewed.
    pub ended: Option<Origin>,
    /// The program that ran before this reset, as the handoff says; 0 for none.
    pub program: u8,
    /// The node-ID that is valid from this reset on, as stored or of switches; 255 for none.
    pub node_id: u8,
    /// The bit rate that is valid from this reset on.
    pub bit_rate: BitRate,
    /// [`Store::Asked`] was carried out, or cannot be.
    pub stored: bool,
}

impl Woken {
    /// After a power-on without anything else.
    pub const fn power_on(node_id: u8, bit_rate: BitRate) -> Self {
        Self {
            cause: ResetCause::PowerOn,
            request: None,
            is_marked: false,
            strap: false,
            ended: None,
            program: 0,
            node_id,
            bit_rate,
            stored: false,
        }
    }

    /// [`Store::Asked`] comes first.
    const fn is_asked_to_store(&self) -> bool {
        use BootRequest::{Confirm, Invalidate, StoreNode};
        !self.stored && matches!(self.request, Some(Confirm(_) | Invalidate(_) | StoreNode(_)))
    }

    /// Which one of two resets by the pin this is.
    const fn pin_reset(&self) -> PinReset {
        match (self.cause, self.request, self.is_marked) {
            (ResetCause::Pin, None, false) => PinReset::First,
            (ResetCause::Pin, None, true) => PinReset::Second,
            _ => PinReset::None,
        }
    }

    /// How a trial has ended by this reset, if the image that ran was on trial. A confirmed one is
    /// not.
    fn trial_end(&self, record: Option<RenewalRecord>) -> TrialEnd {
        let is_staged = record.is_some_and(|record| record.state == State::Staged);
        match self.request {
            Some(BootRequest::Renewal(TrialStep::Late)) => TrialEnd::Late,
            Some(BootRequest::Renewal(TrialStep::GivenUp)) => TrialEnd::GivenUp,
            _ if is_staged && self.ended == Some(Origin::Trial) => TrialEnd::Reset(self.cause),
            _ => TrialEnd::None,
        }
    }

    /// The request that counts: after a trial that a reset has ended, the image at home says why.
    const fn request_after(&self, trial_end: TrialEnd) -> Option<BootRequest> {
        match (trial_end, self.request) {
            (TrialEnd::Reset(_), None | Some(BootRequest::Fault)) => {
                Some(BootRequest::Renewal(TrialStep::GivenUp))
            }
            (_, request) => request,
        }
    }

    /// What the RAM image is told: why it runs, and what is left for it.
    #[must_use]
    // The boot stage calls it once; by itself the compiler takes what never returns for too rare.
    #[inline(always)]
    pub fn report(&self, stay: Stay, crash_resets: u32, renewal: u32) -> BootReport {
        let (returned, program_reset) = match self.request {
            // An application that requests the bootloader has shown that it can be called back.
            Some(BootRequest::Stay | BootRequest::Owed(_)) => (self.program, self.cause as u8),
            None => (0, self.cause as u8),
            // The bootloader itself left these requests.
            Some(_) => (0, 0),
        };
        BootReport {
            reason: stay.reason as u8,
            refused: stay.refused,
            program_reset,
            crash_resets: crash_resets.min(u32::from(u8::MAX)) as u8,
            held_program: stay.held,
            window_ms: stay.window_ms,
            owed: if let Some(BootRequest::Owed(owed)) = self.request { owed } else { Owed::NOTHING },
            returned,
            node_id: self.node_id,
            bit_rate: self.bit_rate as u8,
            renewal,
        }
    }
}

/// The places of the RAM image, and the judge of what is there.
pub struct Images<C> {
    /// Where it is loaded from after every ordinary reset.
    pub home: Region,
    /// Where a new one waits, in a product whose bootloader can be renewed.
    pub staging: Region,
    /// Whether the image in a place can be loaded; what is needed to enter it.
    pub check: C,
}

impl Images<fn(Region) -> Result<(), Damage>> {
    /// Of a device whose bootloader is always whole.
    pub const SOUND: Self = Self { home: Region::new(0, 0), staging: Region::new(0, 0), check: |_| Ok(()) };
}

impl<C> Images<C> {
    /// The first image that can be loaded. A trial whose image cannot is over: `trial_end` says so.
    ///
    /// # Errors
    /// The damage of the image at home.
    fn load<I>(
        &self,
        policy: &Policy,
        woken: &Woken,
        flash: &impl Flash,
        record: Option<RenewalRecord>,
        trial_end: &mut TrialEnd,
    ) -> Result<(Region, Origin, I), Damage>
    where
        C: Fn(Region) -> Result<I, Damage>,
    {
        let Self { home, staging, ref check } = *self;
        if !policy.renewal {
            return check(home).map(|image| (home, Origin::Home, image));
        }
        let tries = woken.request == Some(BootRequest::Renewal(TrialStep::Try));
        let mut damage = Damage::Header;
        let order = Places { home, staging }.order(flash, record, tries);
        for (place, origin) in order.into_iter().flatten() {
            match check(place) {
                Ok(image) => return Ok((place, origin, image)),
                Err(found) if origin == Origin::Trial => *trial_end = TrialEnd::Damaged(found),
                Err(found) if origin == Origin::Home => damage = found,
                Err(_) => {}
            }
        }
        Err(damage)
    }
}

/// What the boot stage does, in the order of the fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Choice<I> {
    /// To be stored. If that fails, the start continues.
    pub store: Option<Store>,
    /// The boot stage waits for a second reset by the pin ([`PinReset::First`]).
    pub waits: bool,
    /// To be left in the warm-start cell, for a debugger: why no RAM image can be loaded.
    pub damage: Option<Damage>,
    /// How the boot stage ends.
    pub exit: Exit<I>,
}

/// A value that the boot stage stores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Store {
    /// What the request of a sealed program asks for: it could not store that itself, because the
    /// flash was locked.
    Asked,
    /// The new number of consecutive crash resets.
    CrashCount(u32),
}

/// How the boot stage ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit<I> {
    /// It starts a program.
    Program(Start),
    /// It enters the RAM image.
    Bootloader {
        /// The place of the image in flash.
        place: Region,
        /// The place, and why it is this one.
        origin: Origin,
        /// From [`Images::check`].
        image: I,
        /// Why it runs.
        stay: Stay,
        /// The number of consecutive crash resets.
        crash_resets: u32,
        /// Its origin, and how the last trial of an image ended: see [`word`].
        renewal: u32,
    },
    /// Nothing can run: the chip resets again and again.
    Again,
    /// It chooses once more, with [`Woken::stored`]: what was stored decides.
    Choose,
}

/// Why the device stays in the bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stay {
    /// The reason.
    pub reason: Reason,
    /// The program that should have started and may not: one that a client requested, or a damaged
    /// one that would start by itself; 0 for none.
    pub refused: u8,
    /// The program that is held back, and then starts unless a client sends a request; 0 for none.
    pub held: u8,
    /// For how long it is held back, in ms; 0 to compact the store, whatever a client asks for.
    pub window_ms: u16,
}

impl Stay {
    const fn for_reason(reason: Reason) -> Self {
        Self { reason, refused: 0, held: 0, window_ms: 0 }
    }

    const fn held(reason: Reason, held: u8, window_ms: u16) -> Self {
        Self { reason, refused: 0, held, window_ms }
    }
}

/// The start of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Start<V = VectorTable> {
    /// Its number, 1 to 254.
    pub number: u8,
    /// For the jump: the proof of its checks.
    pub vectors: V,
    /// The program starts once without a release.
    pub trial: bool,
    /// The flash is locked before, until the next reset
    /// ([`VerifiedProgram::locks_flash`]).
    pub locks_flash: bool,
}

/// A reset by the NRST pin, for a product that two of them keep in the bootloader.
///
/// After the first one the boot stage waits before it starts a program. It then marks the warm-start
/// cell ([`WarmStart::MARKED`](shared_abi::warm_start::WarmStart::MARKED)) for a while: a reset in this time is the
/// second one. A power-on, a watchdog or a request is none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PinReset {
    /// Another reset, or a product without this choice.
    #[default]
    None,
    /// The first one.
    First,
    /// The second one.
    Second,
}

impl PinReset {
    /// After a reset by the pin, the time until the mark is set, in ms: a push-button bounces.
    pub const BOUNCE_MS: u32 = 20;
    /// After a reset by the pin, the time until the mark is removed and a program may start, in ms.
    pub const WITHIN_MS: u32 = 500;
}

/// The programs that start by themselves after a reset: the first one that is valid and may start.
#[derive(Clone, Copy, Debug)]
pub enum Autostart {
    /// Each program of the layout, the lowest number first.
    InOrder,
    /// These, in this order. With an empty list the device waits for a command.
    List(&'static [u8]),
    /// The list that a function returns, for instance one that reads a switch. As
    /// [`Policy::start_allowed`].
    Function(fn() -> &'static [u8]),
}

impl Autostart {
    /// The programs in the order in which they are tried; `programs`: those of the layout.
    fn order(self, programs: &'static [u8]) -> &'static [u8] {
        match self {
            Self::InOrder => programs,
            Self::List(list) => list,
            Self::Function(list) => list(),
        }
    }
}

/// A product, as far as the boot stage knows it. That of a device has constants, and the compiler
/// leaves out what it does not have.
pub trait Product: Copy {
    /// Its choices.
    fn policy(&self) -> &Policy;
}

impl Product for &Policy {
    fn policy(&self) -> &Policy {
        self
    }
}

/// The product's choices for the boot stage.
#[derive(Clone, Debug)]
pub struct Policy {
    /// The programs that start by themselves after a reset.
    pub autostart: Autostart,
    /// The numbers of the programs of the layout, the lowest first; without those that are data.
    pub programs: &'static [u8],
    /// After this many consecutive crash resets, the device stays in the bootloader.
    pub max_crash_resets: u32,
    /// A reset by the pin counts as one by the watchdog: a watchdog chip of the board resets by it.
    pub pin_resets_are_crashes: bool,
    /// The node-IDs with which a program may start.
    pub node_ids: RangeInclusive<u8>,
    /// The rescue window, in ms: how long a program that was never confirmed is held back when it
    /// would start by itself; 0 for no window.
    pub rescue_window_ms: u16,
    /// The rescue window of a confirmed program, in ms.
    pub rescue_window_confirmed_ms: u16,
    /// Whether a program may start now, released or on trial. It is called in the boot stage,
    /// before any peripheral is set up, and when 2007h/2 is read, while the flash may be busy: it
    /// reads no flash, returns at once, and leaves the peripherals as it finds them.
    pub start_allowed: fn(program: u8) -> bool,
    /// Two resets by the pin in a row keep the device in the bootloader ([`PinReset`]).
    pub two_resets: bool,
    /// The bootloader can be renewed: a RAM image may be in staging, too.
    pub renewal: bool,
    /// The device takes sealed programs: [`Store::Asked`] is possible.
    pub sealed: bool,
    /// The regions of the programs.
    pub layout: &'static Layout,
    /// The CRC of the programs.
    pub crc: CrcKind,
}

/// The most resets that are counted, unless the policy wants more: 2007h/4 has no larger number.
const MOST_CRASHES: u32 = 255;

impl Policy {
    /// Each program starts by itself, at once, after fewer than three crashes; nothing else is
    /// chosen.
    #[must_use]
    pub const fn plain(layout: &'static Layout, programs: &'static [u8]) -> Self {
        Self {
            autostart: Autostart::InOrder,
            programs,
            max_crash_resets: 3,
            pin_resets_are_crashes: false,
            node_ids: 1..=127,
            rescue_window_ms: 0,
            rescue_window_confirmed_ms: 0,
            start_allowed: |_| true,
            two_resets: false,
            renewal: false,
            sealed: false,
            layout,
            crc: CrcKind::Crc32,
        }
    }

    /// The number of consecutive resets by which the application ended without a request, including
    /// this one if it is one; `before` is the count up to now. A request resets the count. A
    /// power-on or the reset pin resets it, too, unless the limit was already reached, or the pin is
    /// that of a watchdog chip.
    fn crash_resets(&self, before: u32, cause: ResetCause, request: Option<BootRequest>) -> u32 {
        use ResetCause::{IndependentWatchdog, LowPower, Pin, Software, WindowWatchdog};
        match request {
            Some(
                BootRequest::Fault
                | BootRequest::Resume(_)
                | BootRequest::Damaged(_)
                | BootRequest::Renewal(_),
            ) => before,
            Some(_) => 0,
            None if matches!(cause, IndependentWatchdog | WindowWatchdog | Software | LowPower)
                || self.pin_resets_are_crashes && cause == Pin =>
            {
                // A device that resets for ever does not wear its flash out.
                before.saturating_add(1).min(self.max_crash_resets.max(MOST_CRASHES))
            }
            None if before < self.max_crash_resets => 0,
            None => before,
        }
    }
}

/// The number of consecutive crash resets, as stored.
pub fn crash_count<F: Flash>(parameters: &impl Parameters, flash: &F) -> u32 {
    parameters.get(flash, Key::CRASH_COUNT).map_or(0, |[count, ..]| count)
}

/// Makes the choice. Nothing changes by it.
pub fn choose<I>(
    woken: &Woken,
    images: &Images<impl Fn(Region) -> Result<I, Damage>>,
    flash: &impl Flash,
    parameters: &impl Parameters,
    product: impl Product,
) -> Choice<I> {
    let policy = product.policy();
    if policy.sealed && woken.is_asked_to_store() {
        return Choice { store: Some(Store::Asked), waits: false, damage: None, exit: Exit::Choose };
    }
    let before = crash_count(parameters, flash);
    let crash_resets = match woken {
        // A reset that ends the RAM image is no crash of a program.
        Woken { request: None, ended: Some(_), .. } if policy.renewal => before,
        _ => policy.crash_resets(before, woken.cause, woken.request),
    };
    let record = if policy.renewal { RenewalRecord::load(parameters, flash) } else { None };
    let mut trial_end = if policy.renewal { woken.trial_end(record) } else { TrialEnd::None };
    let request = woken.request_after(trial_end);
    let programs = Programs { node_id: woken.node_id, product, contents: Stored { flash, parameters } };
    let mut decision = programs.decide(Asked { request, strap: woken.strap, crash_resets });
    let would_start = match decision {
        Ok(_) => true,
        Err(stay) => stay.held != 0,
    };
    let pin_reset = if policy.two_resets { woken.pin_reset() } else { PinReset::None };
    if would_start && pin_reset == PinReset::Second {
        decision = Err(Stay::for_reason(Reason::TwoResets));
    }
    let waits = would_start && pin_reset == PinReset::First;
    let store = if crash_resets == before { None } else { Some(Store::CrashCount(crash_resets)) };
    let (damage, exit) = match decision {
        Ok(start) => (None, Exit::Program(start)),
        Err(stay) => match images.load(policy, woken, flash, record, &mut trial_end) {
            Ok((place, origin, image)) => {
                let renewal = if policy.renewal { word(origin, trial_end) } else { 0 };
                (None, Exit::Bootloader { place, origin, image, stay, crash_resets, renewal })
            }
            Err(damage) => (Some(damage), programs.any().map_or(Exit::Again, Exit::Program)),
        },
    };
    Choice { store, waits, damage, exit }
}

/// Why a power-on would leave the device in the bootloader, by the rules of [`choose`]; `None` if a
/// program would start, after its rescue window perhaps. `crash_resets` is the number as stored,
/// `node_id` that of the device, 255 for none.
pub fn next_stay(
    strap: bool,
    crash_resets: u32,
    node_id: u8,
    product: impl Product,
    contents: impl Contents,
) -> Option<Reason> {
    let programs = Programs { node_id, product, contents };
    match programs.decide(Asked { request: None, strap, crash_resets }) {
        Err(Stay { reason, held: 0, .. }) => Some(reason),
        _ => None,
    }
}

/// A program that may be started.
struct Candidate {
    number: u8,
    /// Also without a release.
    trial: bool,
    /// A client has requested it.
    is_requested: bool,
}

impl Candidate {
    const fn by_itself(number: u8) -> Self {
        Self { number, trial: false, is_requested: false }
    }

    const fn requested(number: u8, trial: bool) -> Self {
        Self { number, trial, is_requested: true }
    }
}

/// The programs of the device. Each one that is tried is checked.
struct Programs<P, C> {
    node_id: u8,
    product: P,
    contents: C,
}

/// What is known of the contents of the programs.
pub trait Contents {
    /// The vectors of a program whose contents are good: the proof of its checks.
    type Vectors: Copy;

    /// Checks a program.
    ///
    /// # Errors
    /// [`Reason::NoProgram`], or what is wrong with it.
    fn check(&self, product: impl Product, number: u8) -> Result<VerifiedProgram<Self::Vectors>, Reason>;

    /// As [`Parameters::is_nearly_full`].
    fn is_nearly_full(&self) -> bool {
        false
    }
}

/// The contents of the flash, checked completely.
struct Stored<'a, F, S> {
    flash: &'a F,
    parameters: &'a S,
}

impl<F: Flash, S: Parameters> Contents for Stored<'_, F, S> {
    type Vectors = VectorTable;

    fn check(&self, product: impl Product, number: u8) -> Result<VerifiedProgram, Reason> {
        let Policy { layout, crc, .. } = *product.policy();
        verify(self.flash, self.parameters, layout, crc, number).map_err(|invalid| match invalid {
            Invalid::NoSuchProgram | Invalid::Absent => Reason::NoProgram,
            Invalid::Size | Invalid::Crc => Reason::Damaged,
            Invalid::Vectors(_) => Reason::Vectors,
        })
    }

    fn is_nearly_full(&self) -> bool {
        self.parameters.is_nearly_full()
    }
}

/// The inputs of a decision that a damaged RAM image changes.
#[derive(Clone, Copy)]
struct Asked {
    request: Option<BootRequest>,
    strap: bool,
    crash_resets: u32,
}

impl<P: Product, C: Contents> Programs<P, C> {
    /// Decides between them and the bootloader.
    fn decide(&self, asked: Asked) -> Result<Start<C::Vectors>, Stay> {
        let Policy { autostart, programs, max_crash_resets, .. } = *self.product.policy();
        let stay = |reason| Err(Stay::for_reason(reason));
        match asked.request {
            Some(BootRequest::Stay | BootRequest::Owed(_)) => return stay(Reason::Requested),
            Some(BootRequest::Fault) => return stay(Reason::Fault),
            Some(BootRequest::Renewal(_)) => return stay(Reason::Renewal),
            _ => {}
        }
        if asked.strap {
            return stay(Reason::Strap);
        }
        let mut others: &[u8] = &[];
        // A request is new: its sender knows about earlier crashes.
        let candidate = match asked.request {
            Some(BootRequest::Trial(number) | BootRequest::Fresh(number)) => {
                Candidate::requested(number, true)
            }
            Some(BootRequest::Start(number)) => Candidate::requested(number, false),
            Some(BootRequest::Resume(number) | BootRequest::Confirm(number)) => Candidate::by_itself(number),
            _ if asked.crash_resets >= max_crash_resets => return stay(Reason::CrashLoop),
            _ => match autostart.order(programs) {
                [first, rest @ ..] => {
                    others = rest;
                    Candidate::by_itself(*first)
                }
                [] => return stay(Reason::NoAutostart),
            },
        };
        let mut decision = self.start(asked.request, candidate);
        for number in others {
            // A layout with one program has no other one: the compiler leaves the loop out.
            let (Err(Stay { reason, held: 0, .. }), true) = (decision, programs.len() > 1) else { break };
            let other = self.start(asked.request, Candidate::by_itself(*number));
            // The reason to stay is that of the first program that is there.
            if reason == Reason::NoProgram || !matches!(other, Err(Stay { held: 0, .. })) {
                decision = other;
            }
        }
        decision
    }

    /// The program that starts if there is no bootloader to stay in, neither for the entry strap
    /// nor for the reset pin or a rescue window: one with autostart, or any other one.
    fn any(&self) -> Option<Start<C::Vectors>> {
        let Policy { autostart, programs, .. } = *self.product.policy();
        let start = |number: &u8| {
            let request = Some(BootRequest::Resume(*number));
            self.decide(Asked { request, strap: false, crash_resets: 0 }).ok()
        };
        // With one program both are the same.
        let first = if programs.len() > 1 { autostart.order(programs) } else { &[] };
        first.iter().chain(programs).find_map(start)
    }

    /// Decides about the start of one program.
    fn start(&self, request: Option<BootRequest>, candidate: Candidate) -> Result<Start<C::Vectors>, Stay> {
        let Candidate { number, trial, is_requested } = candidate;
        let Policy { node_ids, start_allowed, .. } = self.product.policy();
        let refused = if is_requested { number } else { 0 };
        let refuse = |reason, refused| Err(Stay { refused, ..Stay::for_reason(reason) });
        if !node_ids.contains(&self.node_id) {
            return refuse(Reason::NodeId, refused);
        }
        match self.check(number) {
            Err(Reason::NoProgram) => refuse(Reason::NoProgram, refused),
            Err(reason) => refuse(reason, number),
            Ok(program) if !(program.signed || trial) => refuse(Reason::Unsigned, refused),
            Ok(_) if !start_allowed(number) => refuse(Reason::Forbidden, refused),
            Ok(program) => {
                let window_ms = self.rescue_window(request, program.confirmed);
                // The bootloader has just had its turn if it has left a request.
                let resumed = matches!(request, Some(BootRequest::Resume(_)));
                if window_ms > 0 {
                    Err(Stay::held(Reason::Rescue, number, window_ms))
                } else if self.contents.is_nearly_full() && !is_requested && !resumed {
                    Err(Stay::held(Reason::Compaction, number, 0))
                } else {
                    Ok(Start {
                        number,
                        vectors: program.vectors,
                        trial: trial && !program.signed,
                        locks_flash: program.locks_flash,
                    })
                }
            }
        }
    }

    /// How long the start of a program is held back, in ms. A requested start is not: the
    /// requesting master asks for the program at once, and this request would keep the device in
    /// the bootloader.
    fn rescue_window(&self, request: Option<BootRequest>, confirmed: bool) -> u16 {
        match request {
            None if confirmed => self.product.policy().rescue_window_confirmed_ms,
            // It has refused to leave.
            None | Some(BootRequest::Rescue) => self.product.policy().rescue_window_ms,
            Some(_) => 0,
        }
    }

    fn check(&self, number: u8) -> Result<VerifiedProgram<C::Vectors>, Reason> {
        let Policy { layout, programs, .. } = *self.product.policy();
        // Data of the profile are no program.
        if programs.len() < layout.programs.len() && !programs.contains(&number) {
            return Err(Reason::NoProgram);
        }
        self.contents.check(self.product, number)
    }
}
