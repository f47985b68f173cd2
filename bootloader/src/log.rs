//! A few words for whoever ports the bootloader (SYS TEC manual L-1112d_10, 4.7): over RTT, which any debug probe's viewer shows.
//! They are there with the feature `log-rtt` alone.
//!
//! RTT is a ring buffer in RAM that the probe finds by its first bytes and reads while the program runs. A line that finds no
//! room is left out: nobody waits for a probe.

use core::sync::atomic::{AtomicPtr, AtomicU32, AtomicU8, Ordering};

use boot_core::canopen::od::{Address, Objects};
use boot_core::canopen::program::{FLASH_STATUS, PROGRAM_CONTROL};
use boot_core::canopen::Frame;

/// Whether anything is said.
pub const ON: bool = cfg!(feature = "log-rtt");

/// Says something, and a number that goes with it.
macro_rules! log {
    ($words:literal, $number:expr) => {
        if $crate::log::ON {
            $crate::log::line($words, $number)
        }
    };
}
pub(crate) use log;

/// SEGGER's control block with one buffer up and none down (UM08001 section 16.4).
#[repr(C)]
struct ControlBlock {
    id: [AtomicU32; 4],
    up_buffers: AtomicU32,
    down_buffers: AtomicU32,
    name: AtomicPtr<u8>,
    buffer: AtomicPtr<u8>,
    size: AtomicU32,
    /// Where the next byte goes; ours.
    written: AtomicU32,
    /// Where the probe reads next; the probe's.
    read: AtomicU32,
    /// 0: what finds no room is left out.
    flags: AtomicU32,
}

const SIZE: u32 = 1024;
static BUFFER: [AtomicU8; SIZE as usize] = [const { AtomicU8::new(0) }; SIZE as usize];

/// The name by which a viewer may find it in the ELF file.
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

/// Makes the block known. The first bytes come last: a probe may look at any time, and must not find them anywhere else.
fn open() {
    CONTROL.up_buffers.store(1, Ordering::Relaxed);
    CONTROL.name.store(c"log".as_ptr().cast_mut().cast(), Ordering::Relaxed);
    CONTROL.buffer.store(BUFFER.as_ptr().cast_mut().cast(), Ordering::Relaxed);
    CONTROL.size.store(SIZE, Ordering::Relaxed);
    for (word, text) in CONTROL.id.iter().zip([*b"SEGG", *b"ER R", *b"TT\0\0"]) {
        word.store(u32::from_le_bytes(text), Ordering::Release);
    }
}

/// Writes a line, if there is room for it.
pub fn line(words: &str, number: u32) {
    const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
    let digits = (0..8).rev().map(|digit| DIGITS[(number >> (4 * digit) & 0xF) as usize]);
    // One line behind the other, whoever writes.
    cortex_m::interrupt::free(|_| {
        if CONTROL.size.load(Ordering::Relaxed) == 0 {
            open();
        }
        let mut at = CONTROL.written.load(Ordering::Relaxed);
        let used = at.wrapping_sub(CONTROL.read.load(Ordering::Acquire)) % SIZE;
        // Number, blank and end of line; and a full ring would look like an empty one.
        if used as usize + words.len() + 11 >= SIZE as usize {
            return;
        }
        for byte in words.bytes().chain([b' ']).chain(digits).chain(*b"\r\n") {
            BUFFER[(at % SIZE) as usize].store(byte, Ordering::Relaxed);
            at = (at + 1) % SIZE;
        }
        CONTROL.written.store(at, Ordering::Release);
    });
}

/// A frame came in: says which command it is, if it is one. (A segment of a block transfer may look like one.)
pub fn received(frame: &Frame) {
    if !ON {
        return;
    }
    let [low, high] = PROGRAM_CONTROL.to_le_bytes();
    match frame.exactly::<8>() {
        // An expedited download (CiA 301 section 7.2.4.3.3).
        Some(&[0x20..=0x2F, l, h, program, command, ..]) if [l, h] == [low, high] => {
            log!("1F51h; program and command", u32::from(program) << 8 | u32::from(command));
        }
        _ => {}
    }
}

/// A frame goes out: says why the device refuses something, and which emergency it has.
pub fn sent(frame: &Frame) {
    if !ON {
        return;
    }
    let (Some(id), Some(data)) = (frame.cob_id(), frame.exactly::<8>()) else { return };
    match (id.get(), data) {
        (0x581..=0x5FF, &[0x80, _, _, _, a, b, c, d]) => {
            log!("refused; abort code", u32::from_le_bytes([a, b, c, d]));
        }
        (0x081..=0x0FF, &[low, high, _, detail, ..]) => {
            log!("emergency; code and detail", u32::from_le_bytes([detail, 0, low, high]));
        }
        _ => {}
    }
}

/// Says how the last block or command of a program ended (1F57h), when that changes.
pub fn status(device: &mut impl Objects, programs: u8) {
    /// Program and what was said last of it.
    static SAID: AtomicU32 = AtomicU32::new(0);
    const BUSY: u8 = 1;
    if !ON {
        return;
    }
    for sub in 1..=programs {
        let mut word = [0; 4];
        let at = Address { index: FLASH_STATUS, sub };
        if device.read(at, &mut word).is_err() || word[0] & BUSY != 0 {
            continue;
        }
        let now = u32::from_le_bytes(word) & 0xFFFF | u32::from(sub) << 16;
        let before = SAID.load(Ordering::Relaxed);
        // All is well with a program that nothing was said of.
        if now != before && (word != [0; 4] || before >> 16 == u32::from(sub)) {
            SAID.store(now, Ordering::Relaxed);
            log!("1F57h; program and status", now);
        }
    }
}
