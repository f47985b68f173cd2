//! The boot decision: bootloader or program, made once after every reset before any peripheral is
//! touched.
//!
//! The order is the product's promise (docs/architecture.md): what asks for the bootloader comes
//! first, so that no program, however broken, can keep a device from being reached.

use core::ops::RangeInclusive;

use shared_abi::handoff::ResetCause;
use shared_abi::warm_start::BootRequest;

use crate::program::{Invalid, VerifiedProgram};

/// What a reset leaves to decide on.
#[derive(Clone, Copy, Debug)]
pub struct Circumstances {
    /// The request in the warm-start cell, consumed.
    pub request: Option<BootRequest>,
    /// The entry strap asks for the bootloader.
    pub strap: bool,
    /// [`Policy::crash_resets`].
    pub crash_resets: u32,
    /// Node-ID of the device; one outside 1 to 127 is no node-ID.
    pub node_id: u8,
}

/// What the product is configured for.
#[derive(Clone, Debug)]
pub struct Policy {
    /// The program that starts by itself after a reset, if any.
    pub autostart: Option<u8>,
    /// This many crash resets in a row end in the bootloader.
    pub max_crash_resets: u32,
    /// Node-IDs with which programs may be started.
    pub node_ids: RangeInclusive<u8>,
    /// How long a program that was never confirmed is held back when it would start by itself, in
    /// ms; 0 for one that starts at once.
    pub rescue_window_ms: u16,
    /// The same for a confirmed program.
    pub rescue_window_confirmed_ms: u16,
    /// Whether a program may be started now, signed or on trial.
    pub start_allowed: fn(program: u8) -> bool,
}

impl Policy {
    /// Resets in a row by which the application ended without being asked to, this one among them
    /// if it is one; `before` were counted. A request is a new beginning, and so is a power-on or
    /// the reset pin, but not for an application that was given up already.
    #[must_use]
    pub fn crash_resets(&self, before: u32, cause: ResetCause, request: Option<BootRequest>) -> u32 {
        use ResetCause::{IndependentWatchdog, LowPower, Software, WindowWatchdog};
        match request {
            Some(BootRequest::Fault | BootRequest::Resume(_) | BootRequest::Damaged(_)) => before,
            Some(_) => 0,
            None if matches!(cause, IndependentWatchdog | WindowWatchdog | Software | LowPower) => {
                before.saturating_add(1)
            }
            None if before < self.max_crash_resets => 0,
            None => before,
        }
    }
}

/// Why the device stays in the bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StayReason {
    /// The application (or a tool through it) asked for it.
    Requested,
    /// The entry strap is set.
    Strap,
    /// Too many crash resets in a row.
    CrashLoop,
    /// Autostart is off and nothing was asked for.
    NoAutostart,
    /// The node-ID is not in the program's range.
    NodeId,
    /// The program was not signed, and this is no trial.
    Unsigned,
    /// The program may not be started.
    Program(Invalid),
    /// The bootloader had a fault or a panic.
    Fault,
    /// A program could start, and waits for the end of the rescue window.
    Rescue,
}

impl StayReason {
    /// The number under which the bus is told.
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::Requested => 0,
            Self::Strap => 1,
            Self::CrashLoop => 2,
            Self::NoAutostart => 3,
            Self::NodeId => 4,
            Self::Unsigned => 5,
            Self::Program(_) => 6,
            Self::Fault => 7,
            Self::Rescue => 8,
        }
    }

    /// Whether a code stands for a misfortune that an emergency should tell of.
    #[must_use]
    pub const fn is_trouble(code: u8) -> bool {
        code == Self::CrashLoop.code() || code == Self::Fault.code()
    }
}

/// What the bootloader does after a reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BootDecision {
    /// Bootloader mode.
    Stay(StayReason),
    /// Bootloader mode for a while: a client that asks meanwhile keeps the device there. Then the
    /// program starts.
    Hold {
        /// Its number.
        program: u8,
        /// How long, in ms.
        window_ms: u16,
    },
    /// Jump.
    Start {
        /// The program, with the proof of its checks.
        program: VerifiedProgram,
        /// Started without a signature, for once.
        trial: bool,
    },
}

/// Decides. `verify` checks a program completely and is asked at most once.
pub fn decide(
    circumstances: &Circumstances,
    policy: &Policy,
    verify: impl FnOnce(u8) -> Result<VerifiedProgram, Invalid>,
) -> BootDecision {
    use BootDecision::{Hold, Start, Stay};

    match circumstances.request {
        Some(BootRequest::Stay | BootRequest::Owed(_)) => return Stay(StayReason::Requested),
        Some(BootRequest::Fault) => return Stay(StayReason::Fault),
        _ => {}
    }
    if circumstances.strap {
        return Stay(StayReason::Strap);
    }
    let (number, trial) = match circumstances.request {
        // A request is new: whoever makes it knows of the crashes before.
        Some(BootRequest::Trial(number) | BootRequest::Fresh(number)) => (number, true),
        Some(BootRequest::Start(number) | BootRequest::Resume(number) | BootRequest::Confirm(number)) => {
            (number, false)
        }
        _ => {
            if circumstances.crash_resets >= policy.max_crash_resets {
                return Stay(StayReason::CrashLoop);
            }
            match policy.autostart {
                Some(number) => (number, false),
                None => return Stay(StayReason::NoAutostart),
            }
        }
    };
    if !policy.node_ids.contains(&circumstances.node_id) {
        return Stay(StayReason::NodeId);
    }
    match verify(number) {
        Err(invalid) => Stay(StayReason::Program(invalid)),
        Ok(program) if !(program.signed() || trial) || !(policy.start_allowed)(number) => {
            Stay(StayReason::Unsigned)
        }
        Ok(program) => {
            let window_ms =
                if program.confirmed() { policy.rescue_window_confirmed_ms } else { policy.rescue_window_ms };
            // A start that was asked for is not held back: the master that asked looks for the
            // program at once, and would keep the device in the bootloader by that.
            if circumstances.request.is_none() && window_ms > 0 {
                return Hold { program: program.number(), window_ms };
            }
            Start { trial: trial && !program.signed(), program }
        }
    }
}
