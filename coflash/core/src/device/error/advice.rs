//! The advice for an error.

use canopen::program::FlashError;
use canopen::program::{ACCESS, EVENTS};
use canopen::{AbortCode, NodeId};

use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;

use super::{absent, Error, LssFailure, TrialFailure, LOW_SUPPLY};
use crate::device::doing::{Doing, LssDoing};
use crate::device::state::BootloaderState;

impl Error {
    /// What to do next.
    #[must_use]
    pub fn advice(&self) -> String {
        match self {
            Self::Adapter(error) => error.advice(),
            Self::Cancelled => "run the same command again to continue".to_string(),
            Self::NoAnswer { node, .. } => format!(
                "check that node {node} is the right one, that the device has power, that both sides use the same bit \
                 rate and that the bus is terminated; a slow device may need a longer --sdo-timeout"
            ),
            Self::ShortAnswer { .. } => "SDO frames have 8 bytes (CiA 301 clause 7.2.4.3): look for a setting of the \
                                         device that fills them up, or ask its manufacturer"
                .to_string(),
            Self::Refused { doing: Doing::Unlock, code, .. } => unlock_advice(*code).to_string(),
            Self::Refused { doing: Doing::Read(at) | Doing::Write(at), code, .. }
                if at.index == canopen::debugger::DEBUGGER =>
            {
                debugger_advice(*code).to_string()
            }
            Self::Refused { doing: Doing::Read(at) | Doing::Write(at), code, .. }
                if matches!(at.index, ACCESS | EVENTS) && absent(*code) =>
            {
                "the bootloader has this object, and its application need not have it: coflash enter calls the \
                 bootloader; one without support for sealed images has none"
                    .to_string()
            }
            Self::Refused { code, .. } => refusal_advice(*code).to_string(),
            Self::NotInDialect { .. } => "leave out this option, or name another dialect with --dialect".to_string(),
            Self::NoPassword { .. } => "give the device's password with --unlock; its manufacturer knows it".to_string(),
            Self::Occupied { node } => format!(
                "finish the update of the device that is node {node} now, or switch that device off; then run the command again"
            ),
            Self::NotAlone { .. } => "wait until the other tool has finished, or end it; then run the command again; coflash flash \
                                      --not-alone goes on all the same, at the risk that both fail"
                .to_string(),
            Self::Protocol { .. } => "look for a second tool or a second device with this node-ID on the bus; a longer \
                                      --sdo-timeout helps against answers that come late"
                .to_string(),
            Self::Failed { error: FlashError::Crc, doing: Doing::Block(0), .. } => {
                "the device finds a wrong CRC in a block that has arrived whole: it checks with the other CRC, or another tool \
                 writes to it, too. Each repeat of block 0 has the other CRC: leave out --block-repeats 0, or give --crc16 \
                 for a product with CRC-16; then end the other tool"
                    .to_string()
            }
            Self::Failed { error: FlashError::Secured, detail: sector @ 1.., .. } => format!(
                "take the write protection of sector {sector} away with a debug probe (option bytes: nWRP, SPRMOD), and \
                 look whether the installed program sets it; nothing of that program is lost"
            ),
            Self::Failed { error: FlashError::NotCleared, detail: program @ 1.., .. } => format!(
                "clear that program first, and install it again afterwards: coflash erase --program {program}"
            ),
            Self::Failed { doing: Doing::Bootloader, error: FlashError::Format, .. } => {
                "the file is a bootloader for another board, for a newer resident part, or not the one of this product: \
                 coflash info shows what the device has"
                    .to_string()
            }
            Self::Failed { error: FlashError::NoAccess, detail: LOW_SUPPLY, .. } => {
                "check the supply of the device under load, from its source to the chip (coflash info says whether it \
                 is good), and run the command again"
                    .to_string()
            }
            Self::Failed { error, .. } => failure_advice(*error).to_string(),
            Self::NotRenewable { .. } => "write it with a debug probe; a product with renewal needs a layout with staging \
                                          (docs/renewal.md)"
                .to_string(),
            Self::Unconfirmable { .. } => "build the bootloader for a product with renewal (docs/renewal.md): it could not be \
                                           renewed again"
                .to_string(),
            Self::FirstFailed { first } => format!("find out why node {first} has failed, and run the command again"),
            Self::RenewalFailed { .. } => "nothing is lost: look whether the file is the bootloader of this product and of its \
                                           bit rate, and run the command again; a reset that nobody asked for has its cause \
                                           in coflash info"
                .to_string(),
            Self::SilentOnTrial { .. } => "nothing is lost: the old bootloader comes back by itself at the end of the trial \
                                           (renewal_s of the product, 60 s if it has no other), or at once when the device \
                                           is switched off and on; for a product with a longer time give that time and 15 s \
                                           more, in ms, as --boot-timeout"
                .to_string(),
            Self::WrongTarget { what, .. } => failure_advice(what.error()).to_string(),
            Self::SealedOnly { .. } => "seal the program with a key that a root of the device has certified (coflash seal), and \
                                        flash the sealed image"
                .to_string(),
            Self::NoProgram { advice, .. } => (*advice).to_string(),
            Self::OtherRegion { .. } => "link the program for that address, or check --program and --board; \
                                         --force leaves that to the device"
                .to_string(),
            Self::OtherIdentity { .. } => "check that the program was made for this device: it is not released for autostart; \
                                           one that has an identity of its own is flashed with --no-trial"
                .to_string(),
            Self::Busy { .. } => "give it more time with --command-timeout, or switch the device off and on".to_string(),
            Self::NoBootloader { elsewhere: Some(other), .. } => format!(
                "if node {other} is this device (coflash info --node {other}), its bootloader has another node-ID than \
                 its application: run the command again with --node {other}"
            ),
            Self::NoBootloader { code: Some(_), .. } => {
                "this application cannot be called back: bring the device into the bootloader by its entry strap, or \
                 within its rescue window after power-on"
                    .to_string()
            }
            Self::NoBootloader { .. } => "switch the device off and on and run the command again; if its application \
                                          ignores the call, coflash catch holds the device in the bootloader while it is \
                                          switched off and on (rescue window), and so does the entry strap"
                .to_string(),
            Self::Lss { doing, failure: LssFailure::NoAnswer } => match doing {
                LssDoing::Fastscan => "run it again; if it happens again, two devices may have one LSS address",
                LssDoing::Select => {
                    "check the four numbers of the address (coflash info shows them as identity), and that the device \
                     has power"
                }
                _ => "check that the device supports LSS, that it has power, and that both sides use the same bit rate",
            }
            .to_string(),
            Self::Lss { failure: LssFailure::None, .. } => {
                "give the node-ID for the device, or set it with coflash lss assign".to_string()
            }
            Self::Lss { doing, failure: LssFailure::Refused { code, .. } } => match (doing, code) {
                (LssDoing::Store, 1) => "this device cannot store node-ID and bit rate: its switches or its application set them",
                (LssDoing::Store, _) => "run it again; if it happens again, the device's memory is broken",
                (LssDoing::BitRate, _) => "choose a bit rate that the device supports",
                _ => "choose a node-ID from 1 to 127",
            }
            .to_string(),
            Self::WrongCrc { .. } => {
                "check that the file was made for this board and this program number, and run the command again"
                    .to_string()
            }
            Self::TrialFailed { how: TrialFailure::NotStarted(_, state), .. } => {
                not_started_advice(*state).to_string()
            }
            Self::TrialFailed {
                how:
                    TrialFailure::Silent(Some(other))
                    | TrialFailure::FellSilent(Some(other))
                    | TrialFailure::Lost(Some(other)),
                ..
            } => {
                format!("{}; one that is to keep its own is flashed with --no-trial", elsewhere_advice(*other))
            }
            Self::TrialFailed {
                node,
                how: TrialFailure::Silent(None) | TrialFailure::FellSilent(None) | TrialFailure::Lost(None),
            } => format!(
                "switch the device off and on: it comes up in the bootloader, ready for another program (coflash catch \
                 --node {node} waits for it); the program may crash or have a wrong bit rate; for one that answers \
                 under another node-ID than its bootloader there is --no-trial"
            ),
            Self::TrialFailed { node, how: TrialFailure::Stays(_) } => format!(
                "give the program 1F51h = 80h, the way back into the bootloader (docs/application.md): without it the \
                 device can never be updated over the bus. Reset the device (coflash reset --node {node}), or switch it \
                 off and on: it comes up in the bootloader, ready for another program (coflash catch --node {node} \
                 waits for it)"
            ),
            Self::ProgramEnded { ended, .. } | Self::TrialFailed { how: TrialFailure::Ended(ended), .. } => {
                ended_advice(ended.by).to_string()
            }
            Self::StartFailed { running: Some(running), state, .. } if running.is_bootloader() => {
                not_started_advice(*state).to_string()
            }
            Self::StartFailed { elsewhere: Some(other), .. } | Self::FellSilent { elsewhere: Some(other), .. } => {
                elsewhere_advice(*other)
            }
            Self::StartFailed { node, .. } | Self::FellSilent { node, .. } => format!(
                "the program may not speak CANopen, use another node-ID or bit rate, or crash: run coflash catch --node \
                 {node}, switch the device off and on, and flash another one; if it is not caught, use its entry strap"
            ),
        }
    }
}

/// The advice for a device that may have come back as this node.
fn elsewhere_advice(other: NodeId) -> String {
    format!(
        "if node {other} is this device (coflash info --node {other}), its program has another node-ID than its \
         bootloader: let it take that of the handoff (docs/application.md)"
    )
}

/// The advice for a program after whose start the bootloader runs, by what the device says.
fn not_started_advice(state: Option<BootloaderState>) -> &'static str {
    let reason = state.and_then(|state| Reason::from_byte(state.reason));
    let ended_by = state.and_then(BootloaderState::ended_by);
    match (reason, ended_by) {
        (Some(Reason::NoProgram), _) => "flash a program first (coflash flash): the device has none",
        (Some(Reason::Damaged), _) => {
            "flash the program again: what is in the flash is not what was sent; if it happens again, the flash is worn out"
        }
        (Some(Reason::NodeId), _) => {
            "give the device a node-ID in the range of its product (coflash lss assign); the program stays as it is"
        }
        (Some(Reason::Forbidden), _) => {
            "the product forbids the start at present: ask its manufacturer what allows it; the program stays as it is"
        }
        (Some(Reason::Unsigned | Reason::CrashLoop), Some(by)) => ended_advice(Some(by)),
        _ => {
            "check that the program was linked for this board and program number; the device waits in the bootloader \
             for another one"
        }
    }
}

/// The advice for a program that ran for a while.
fn ended_advice(by: Option<ResetCause>) -> &'static str {
    match by {
        Some(ResetCause::IndependentWatchdog | ResetCause::WindowWatchdog) => {
            "the program does not feed its watchdog in time: feed it from its first instructions on \
             (docs/application.md), or watch it for as long as it needs with --watch; --watch 0 does not watch"
        }
        Some(ResetCause::Software) => {
            "the program resets itself, as the handler of a panic or a fault does: read its log, or run it under a \
             debugger; a program that restarts on purpose is flashed with --watch 0"
        }
        Some(ResetCause::PowerOn | ResetCause::BrownOut) => {
            "check the supply of the device: it lost its power while the program ran"
        }
        Some(ResetCause::Standby) => {
            "the program put the device into Standby, and it woke up: a program that does so on purpose is flashed \
             with --watch 0"
        }
        _ => {
            "the program ends by itself: read its log, or run it under a debugger; coflash info says why the device \
             stays in the bootloader; a program that restarts on purpose is flashed with --watch 0"
        }
    }
}

fn failure_advice(error: FlashError) -> &'static str {
    match error {
        FlashError::NoValidProgram => "flash a program, and release it for autostart",
        FlashError::Format => {
            "check that the file is for this bootloader and this board: coflash inspect --board tells whether its \
             stack and its reset vector are those of a program there"
        },
        FlashError::Crc => "run the command again; if it happens again, check bus and terminators",
        FlashError::NotCleared => {
            "run the flash command, which erases first; another tool may be at work on the device"
        }
        FlashError::Write => {
            "run the command again; if it happens again, the flash may be worn out or write-protected"
        }
        FlashError::Address => "the file is for another memory map: check --board and --program",
        FlashError::Secured => {
            "the file wants to write into the bootloader: check how the program is linked; if it is linked right, the \
             flash is write-protected by its option bytes"
        },
        FlashError::NvData => {
            "run the command again; if it happens again, the device cannot store its parameters"
        }
        FlashError::WrongVendorId | FlashError::WrongProductId => {
            "check that file and device belong together (coflash info shows the device's identity)"
        }
        FlashError::NoAccess => {
            "the device forbids this at present. If it is sealed (coflash info says so), it takes sealed images alone \
             (coflash seal), and other changes only with a right, which the signature of a root gives (coflash \
             unlock); otherwise ask its manufacturer what allows it"
        }
        FlashError::Busy => {
            "wait a moment and run the command again; another tool may be at work on the device"
        }
        FlashError::Signature => {
            "check the file with coflash verify and the root's public key; seal the program again with a key \
             that the device's root has certified"
        }
        FlashError::Rollback => {
            "compare counter and epoch in coflash show with those that the device takes, in coflash info: an old \
             program is sealed again with a higher --counter, and in place of an old key sign with the one that is \
             valid now"
        }
        FlashError::Key => {
            "compare the key ids that coflash show tells with those that the device was provisioned with; \
             programs that are signed for tests run on devices for tests alone"
        }
        FlashError::Sequence => "run the command again; another tool may be at work on the device",
        _ => "run the command again, or switch the device off and on first",
    }
}

fn unlock_advice(code: AbortCode) -> &'static str {
    match code {
        AbortCode::NO_OBJECT | AbortCode::NO_SUB_INDEX => {
            "the device has no password: check --dialect, or leave out --unlock"
        }
        AbortCode::DEVICE_STATE => {
            "after a wrong password a device accepts none for a while: try the right one in half a minute"
        }
        _ => "check the password: the device's manufacturer knows it; after wrong passwords the device may accept none for a while",
    }
}

fn refusal_advice(code: AbortCode) -> &'static str {
    match code {
        AbortCode::NO_OBJECT => "the device has no such object: is it a device with this bootloader?",
        AbortCode::NO_SUB_INDEX => "the device has no such program: check --program",
        AbortCode::LENGTH | AbortCode::LENGTH_TOO_HIGH | AbortCode::OUT_OF_MEMORY => {
            "the block may be larger than the bootloader's buffer: convert with a smaller --block-size"
        }
        AbortCode::TIMEOUT | AbortCode::TOGGLE | AbortCode::COMMAND => {
            "frames were lost, or a second tool is at work on the device: check the bus and run the command again"
        }
        _ => "run the command again; if it happens again, the abort code gives the device's reason",
    }
}

/// The advice for a refusal of the debugger interface, 1025h.
fn debugger_advice(code: AbortCode) -> &'static str {
    match code {
        AbortCode::NO_OBJECT => {
            "the device has no debugger interface; no product has one; on the bench, build its firmware with the feature \
             `debugger` (docs/debugger.md)"
        }
        AbortCode::INVALID_VALUE => {
            "these bytes cannot be accessed: there is no memory, or the write is to flash, or it covers part of a register \
             (docs/debugger.md)"
        }
        AbortCode::DEVICE_STATE => {
            "the device is secured: its read-out protection (RDP) has to be taken away first, which erases it"
        }
        AbortCode::LOCAL_CONTROL => "the flash is busy: try again when the erase has ended",
        code => refusal_advice(code),
    }
}
