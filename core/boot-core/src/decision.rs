//! The boot decision: bootloader or program, made once after every reset before any peripheral is
//! used.
//!
//! The order of the checks is a promise of the product (docs/architecture.md): requests for the
//! bootloader come first, so that no program, however broken, can keep a device in the application.

use core::ops::RangeInclusive;

use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;
use shared_abi::warm_start::BootRequest;

use crate::program::{Invalid, VerifiedProgram};

/// The inputs of the decision after a reset.
#[derive(Clone, Copy, Debug)]
pub struct Circumstances {
    /// The request from the warm-start cell, which has been consumed.
    pub request: Option<BootRequest>,
    /// The entry strap asks for the bootloader.
    pub strap: bool,
    /// [`Policy::crash_resets`].
    pub crash_resets: u32,
    /// Node-ID of the device; a value outside 1 to 127 means that it has none.
    pub node_id: u8,
    /// The store is nearly full ([`Parameters::is_nearly_full`](crate::store::Parameters::is_nearly_full)).
    pub nearly_full: bool,
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

    /// From the cause of a reset, and what the warm-start cell had.
    #[must_use]
    pub const fn of(cause: ResetCause, request: Option<BootRequest>, is_marked: bool) -> Self {
        match (cause, request, is_marked) {
            (ResetCause::Pin, None, false) => Self::First,
            (ResetCause::Pin, None, true) => Self::Second,
            _ => Self::None,
        }
    }

    /// What becomes of a decision after this reset: no program starts after the second one.
    #[must_use]
    pub const fn change(self, decision: BootDecision) -> BootDecision {
        match (self, decision) {
            (Self::Second, BootDecision::Start { .. } | BootDecision::Hold { .. }) => {
                BootDecision::Stay { reason: Reason::TwoResets, refused: 0 }
            }
            _ => decision,
        }
    }
}

/// The programs that start by themselves after a reset: the first one that is valid and may start.
#[derive(Clone, Copy, Debug)]
pub enum Autostart {
    /// Each program of the layout, the lowest number first.
    InOrder,
    /// These, in this order. With an empty list the device waits for a command.
    List(&'static [u8]),
    /// The list that a function returns, for instance one that reads a switch. It runs in the boot stage,
    /// before any peripheral is set up, and must leave the peripherals that it uses as after a reset.
    Function(fn() -> &'static [u8]),
}

impl Autostart {
    /// Whether a program can start by itself.
    #[must_use]
    pub const fn is_on(self) -> bool {
        !matches!(self, Self::List([]))
    }

    /// The programs in the order in which they are tried; `programs`: those of the layout.
    fn order(self, programs: &'static [u8]) -> &'static [u8] {
        match self {
            Self::InOrder => programs,
            Self::List(list) => list,
            Self::Function(list) => list(),
        }
    }
}

/// The product's configuration of the decision.
#[derive(Clone, Debug)]
pub struct Policy {
    /// The programs that start by themselves after a reset.
    pub autostart: Autostart,
    /// The numbers of the programs of the layout, the lowest first; without those that are data.
    pub programs: &'static [u8],
    /// After this many consecutive crash resets, the device stays in the bootloader.
    pub max_crash_resets: u32,
    /// The node-IDs with which a program may start.
    pub node_ids: RangeInclusive<u8>,
    /// The rescue window, in ms: how long a program that was never confirmed is held back when it
    /// would start by itself; 0 for no window.
    pub rescue_window_ms: u16,
    /// The rescue window of a confirmed program, in ms.
    pub rescue_window_confirmed_ms: u16,
    /// Whether a program may start now, released or on trial.
    pub start_allowed: fn(program: u8) -> bool,
}

/// The most resets that are counted, unless the policy wants more: 2007h/4 has no larger number.
const MOST_CRASHES: u32 = 255;

impl Policy {
    /// The number of consecutive resets by which the application ended without a request, including
    /// this one if it is one; `before` is the count up to now. A request resets the count. A
    /// power-on or the reset pin resets it, too, unless the limit was already reached.
    #[must_use]
    pub fn crash_resets(&self, before: u32, cause: ResetCause, request: Option<BootRequest>) -> u32 {
        use ResetCause::{IndependentWatchdog, LowPower, Software, WindowWatchdog};
        match request {
            Some(
                BootRequest::Fault
                | BootRequest::Resume(_)
                | BootRequest::Damaged(_)
                | BootRequest::Renewal(_),
            ) => before,
            Some(_) => 0,
            None if matches!(cause, IndependentWatchdog | WindowWatchdog | Software | LowPower) => {
                // A device that resets for ever does not wear its flash out.
                before.saturating_add(1).min(self.max_crash_resets.max(MOST_CRASHES))
            }
            None if before < self.max_crash_resets => 0,
            None => before,
        }
    }
}

/// The bootloader's action after a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BootDecision {
    /// Stay in the bootloader.
    Stay {
        /// The reason.
        reason: Reason,
        /// The program that should have started and may not: one that a client requested, or a damaged
        /// one that would start by itself; 0 for none.
        refused: u8,
    },
    /// Stay in the bootloader for a limited time. If a client sends a request meanwhile, the device
    /// stays there. Otherwise the program starts.
    Hold {
        /// The program's number.
        program: u8,
        /// The time in ms; 0 to compact the store, whatever a client asks for.
        window_ms: u16,
    },
    /// Start a program.
    Start {
        /// The program, with the proof of its checks.
        program: VerifiedProgram,
        /// The program starts once without a release.
        trial: bool,
    },
}

/// Tries programs until one starts, when there is no bootloader to stay in: those with autostart first,
/// then all.
pub fn fallback(policy: &Policy, mut starts: impl FnMut(u8) -> bool) {
    // With one program both are the same.
    let is_choice = policy.programs.len() > 1;
    let first = policy.autostart.order(policy.programs);
    let _ = is_choice && first.iter().any(|number| starts(*number))
        || policy.programs.iter().any(|number| starts(*number));
}

/// Makes the decision. `verify` checks a program completely; it is called once for each program that is
/// tried.
pub fn decide(
    circumstances: &Circumstances,
    policy: &Policy,
    verify: impl Fn(u8) -> Result<VerifiedProgram, Invalid>,
) -> BootDecision {
    use BootDecision::Stay;

    let stay = |reason| Stay { reason, refused: 0 };
    match circumstances.request {
        Some(BootRequest::Stay | BootRequest::Owed(_)) => return stay(Reason::Requested),
        Some(BootRequest::Fault) => return stay(Reason::Fault),
        Some(BootRequest::Renewal(_)) => return stay(Reason::Renewal),
        _ => {}
    }
    if circumstances.strap {
        return stay(Reason::Strap);
    }
    let by_itself = |number| Candidate { number, trial: false, is_requested: false };
    let requested = |number, trial| Candidate { number, trial, is_requested: true };
    let mut others: &[u8] = &[];
    // A request is new: its sender knows about earlier crashes.
    let candidate = match circumstances.request {
        Some(BootRequest::Trial(number) | BootRequest::Fresh(number)) => requested(number, true),
        Some(BootRequest::Start(number)) => requested(number, false),
        Some(BootRequest::Resume(number) | BootRequest::Confirm(number)) => by_itself(number),
        _ if circumstances.crash_resets >= policy.max_crash_resets => return stay(Reason::CrashLoop),
        _ => match policy.autostart.order(policy.programs) {
            [first, rest @ ..] => {
                others = rest;
                by_itself(*first)
            }
            [] => return stay(Reason::NoAutostart),
        },
    };
    let mut decision = start(circumstances, policy, candidate, &verify);
    for number in others {
        // A layout with one program has no other one: the compiler leaves the loop out.
        let (Stay { reason, .. }, true) = (decision, policy.programs.len() > 1) else { break };
        let other = start(circumstances, policy, by_itself(*number), &verify);
        // The reason to stay is that of the first program that is there.
        if reason == Reason::NoProgram || !matches!(other, Stay { .. }) {
            decision = other;
        }
    }
    decision
}

/// A program that may be started.
struct Candidate {
    number: u8,
    /// Also without a release.
    trial: bool,
    /// A client has requested it.
    is_requested: bool,
}

/// Decides about the start of one program.
fn start(
    circumstances: &Circumstances,
    policy: &Policy,
    candidate: Candidate,
    verify: impl Fn(u8) -> Result<VerifiedProgram, Invalid>,
) -> BootDecision {
    use BootDecision::{Hold, Start, Stay};

    let Candidate { number, trial, is_requested } = candidate;
    let refuse = |reason| Stay { reason, refused: if is_requested { number } else { 0 } };
    if !policy.node_ids.contains(&circumstances.node_id) {
        return refuse(Reason::NodeId);
    }
    match verify(number) {
        Err(Invalid::NoSuchProgram | Invalid::Absent) => refuse(Reason::NoProgram),
        Err(Invalid::Size | Invalid::Crc) => Stay { reason: Reason::Damaged, refused: number },
        Err(Invalid::Vectors(_)) => Stay { reason: Reason::Vectors, refused: number },
        Ok(program) if !(program.signed() || trial) => refuse(Reason::Unsigned),
        Ok(_) if !(policy.start_allowed)(number) => refuse(Reason::Forbidden),
        Ok(program) => {
            let refused = circumstances.request == Some(BootRequest::Rescue);
            let proved = program.confirmed() && !refused;
            let window_ms = if proved { policy.rescue_window_confirmed_ms } else { policy.rescue_window_ms };
            // A requested start is not delayed: the requesting master asks for the program at once,
            // and this request would keep the device in the bootloader.
            if (circumstances.request.is_none() || refused) && window_ms > 0 {
                return Hold { program: program.number(), window_ms };
            }
            // The bootloader has just had its turn if it has left a request.
            let resumed = matches!(circumstances.request, Some(BootRequest::Resume(_)));
            if circumstances.nearly_full && !is_requested && !resumed {
                return Hold { program: program.number(), window_ms: 0 };
            }
            Start { trial: trial && !program.signed(), program }
        }
    }
}
