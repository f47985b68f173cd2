//! RTT (SEGGER UM08001 section 16.4): a ring buffer in RAM. A debug probe finds it by its first
//! bytes and reads it while the program runs. A message is left out if the ring has no room for it:
//! the bootloader never waits for a probe.

use core::sync::atomic::{AtomicPtr, AtomicU32, AtomicU8, Ordering};

/// SEGGER's control block with one up buffer and no down buffer.
#[repr(C)]
struct ControlBlock {
    id: [AtomicU32; 4],
    up_buffers: AtomicU32,
    down_buffers: AtomicU32,
    name: AtomicPtr<u8>,
    buffer: AtomicPtr<u8>,
    size: AtomicU32,
    /// Index of the next byte to write; changed by this program.
    written: AtomicU32,
    /// Index of the next byte to read; changed by the probe.
    read: AtomicU32,
    /// 0: a message without room is left out.
    flags: AtomicU32,
}

const SIZE: u32 = 1024;
static BUFFER: [AtomicU8; SIZE as usize] = [const { AtomicU8::new(0) }; SIZE as usize];

/// The buffer's name in a viewer; viewers decode a buffer with the name `defmt`.
const NAME: &core::ffi::CStr = if cfg!(feature = "log-defmt") { c"defmt" } else { c"log" };

/// A viewer can find the block in the ELF file by this name.
#[export_name = "_SEGGER_RTT"]
static CONTROL: ControlBlock = ControlBlock {
    id: [const { AtomicU32::new(0) }; 4],
    up_buffers: AtomicU32::new(0),
    down_buffers: AtomicU32::new(0),
    name: AtomicPtr::new(core::ptr::null_mut()),
    buffer: AtomicPtr::new(core::ptr::null_mut()),
    size: AtomicU32::new(0),
    written: AtomicU32::new(0),
    read: AtomicU32::new(0),
    flags: AtomicU32::new(0),
};

/// Makes the block visible. Its first bytes are written last: a probe may look at any time, and
/// must not find these bytes in an incomplete block.
fn open() {
    CONTROL.up_buffers.store(1, Ordering::Relaxed);
    CONTROL.name.store(NAME.as_ptr().cast_mut().cast(), Ordering::Relaxed);
    CONTROL.buffer.store(BUFFER.as_ptr().cast_mut().cast(), Ordering::Relaxed);
    CONTROL.size.store(SIZE, Ordering::Relaxed);
    for (word, text) in CONTROL.id.iter().zip([*b"SEGG", *b"ER R", *b"TT\0\0"]) {
        word.store(u32::from_le_bytes(text), Ordering::Release);
    }
}

/// A message that is being written: only one at a time, and with interrupts off. The probe sees it
/// when it has ended.
pub struct Message {
    at: u32,
    fits: bool,
}

impl Message {
    /// Begins a message.
    pub fn begin() -> Self {
        if CONTROL.size.load(Ordering::Relaxed) == 0 {
            open();
        }
        Self { at: CONTROL.written.load(Ordering::Relaxed), fits: true }
    }

    /// Adds bytes to the message.
    pub fn put(&mut self, bytes: impl IntoIterator<Item = u8>) {
        for byte in bytes {
            let next = (self.at + 1) % SIZE;
            // One byte stays free: a full ring would look like an empty one.
            self.fits &= next != CONTROL.read.load(Ordering::Acquire);
            if self.fits {
                BUFFER[(self.at % SIZE) as usize].store(byte, Ordering::Relaxed);
                self.at = next;
            }
        }
    }

    /// Makes the message visible to the probe, if there was room for all of it.
    pub fn end(self) {
        if self.fits {
            CONTROL.written.store(self.at, Ordering::Release);
        }
    }
}
