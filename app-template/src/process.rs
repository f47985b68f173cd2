//! The process: what the machine does, and the values that SDO and PDOs read and write. Put yours
//! in their place.

use core::sync::atomic::{AtomicU16, AtomicU8, Ordering::SeqCst};

use canopen::nmt::NmtState;
use canopen::od::{put, Address, Entry, Objects};
use canopen::{AbortCode, CobId, Frame};

use crate::entries::{ACTUAL_VALUE, COMMAND, PROCESS, SETPOINT, STATE};

/// What the machine does: it stands, it moves, or it stands because the device leaves. What moves
/// starts by a `compare_exchange` from `STANDS` to `MOVES`, in whatever task, and not at all if
/// that fails: the question below and the start exclude each other.
pub static MACHINE: AtomicU8 = AtomicU8::new(STANDS);
/// See [`MACHINE`].
pub const STANDS: u8 = 0;
/// See [`MACHINE`].
pub const MOVES: u8 = 1;
/// See [`MACHINE`].
pub const LEAVES: u8 = 2;

/// The value of 2201h.
static SPEED: AtomicU16 = AtomicU16::new(0);

/// Whether the device may leave now, for its bootloader or for a reset. It is asked once, before a
/// command is answered or left to the bootloader: 1F51h = 80h, 0, 2 and 3, and what a sealed
/// program stores. After a no the command is refused (08000022h), and the program stays. A yes is
/// final: the reset follows within half a second, and until then the machine does not start.
pub fn may_leave() -> bool {
    MACHINE.compare_exchange(STANDS, LEAVES, SeqCst, SeqCst).is_ok()
}

fn stop() {
    // It may stand already, or leave.
    let _ = MACHINE.compare_exchange(MOVES, STANDS, SeqCst, SeqCst);
}

/// COB-IDs of frames that the application takes itself, beside NMT, SDO, LSS, SYNC and its RPDOs:
/// TIME (100h), for instance, or the heartbeat of another node. They arrive in [`Process::handle`].
pub const OWN: [CobId; 0] = [];

/// The values are in statics, which other tasks read and write.
pub struct Process;

impl Process {
    /// The NMT state is this one now.
    pub fn state_changed(&mut self, state: NmtState) {
        if state != NmtState::Operational {
            // Nobody drives the machine any more.
            stop();
        }
    }

    /// A frame with one of the [`OWN`] COB-IDs, or with one of the stack.
    pub fn handle(&mut self, frame: &Frame) {
        let _ = frame;
    }
}

impl Objects for Process {
    fn entries(&self) -> &'static [Entry] {
        &PROCESS
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let machine = MACHINE.load(SeqCst);
        let speed = SPEED.load(SeqCst);
        match at.index {
            COMMAND => put(buf, &[u8::from(machine == MOVES)]),
            SETPOINT => put(buf, &speed.to_le_bytes()),
            STATE => put(buf, &[machine]),
            // In the place of a measured value.
            ACTUAL_VALUE => put(buf, &if machine == MOVES { speed } else { 0 }.to_le_bytes()),
            _ => Err(AbortCode::NO_DATA),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        match (at.index, data) {
            (COMMAND, &[0]) => stop(),
            (COMMAND, &[1]) => {
                if MACHINE.compare_exchange(STANDS, MOVES, SeqCst, SeqCst) == Err(LEAVES) {
                    return Err(AbortCode::DEVICE_STATE);
                }
            }
            (SETPOINT, &[low, high]) => SPEED.store(u16::from_le_bytes([low, high]), SeqCst),
            _ => return Err(AbortCode::INVALID_VALUE),
        }
        Ok(())
    }
}
