//! Short log lines for a developer who ports the bootloader (SYS TEC manual L-1112d_10, 4.7). They
//! exist only with these features:
//!
//! | feature | format of a line | output |
//! |---|---|---|
//! | `log-rtt` | text | a debug probe, over RTT |
//! | `log-defmt` | a frame of `defmt`, whose words stay in the ELF file | a debug probe, over RTT |
//! | `log-uart` | text | the board's UART |
//!
//! A line is left out if its output has no room: the bootloader never waits for a reader.

pub mod feeds;
#[cfg(feature = "log-defmt")]
mod logger;
#[cfg(any(feature = "log-rtt", feature = "log-defmt"))]
mod rtt;
#[cfg(feature = "log-uart")]
pub mod uart;

use core::sync::atomic::{AtomicU32, Ordering};

use boot_core::canopen::od::{Address, Objects};
use boot_core::canopen::program::{FLASH_STATUS, PROGRAM_CONTROL};
use boot_core::canopen::Frame;

#[cfg(all(feature = "log-rtt", feature = "log-defmt"))]
compile_error!("log-rtt and log-defmt both write to the one RTT buffer: choose one of them");

#[cfg(all(feature = "log-uart", feature = "virtual-can"))]
compile_error!("log-uart and virtual-can both take the one UART: choose one of them");

/// Whether log lines are written.
pub const ON: bool = cfg!(any(feature = "log-rtt", feature = "log-uart", feature = "log-defmt"));

/// Logs words and a number.
macro_rules! log {
    ($words:literal, $number:expr) => {
        if $crate::log::ON {
            let number: u32 = $number;
            #[cfg(feature = "log-defmt")]
            defmt::println!("{=istr} {=u32:08X}", defmt::intern!($words), number);
            $crate::log::line($words, number)
        }
    };
}
pub(crate) use log;

/// Writes a line to the text outputs.
pub fn line(words: &'static str, number: u32) {
    const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
    let digits = (0..8).rev().map(move |digit| DIGITS[(number >> (4 * digit) & 0xF) as usize]);
    let line = words.bytes().chain([b' ']).chain(digits).chain(*b"\r\n");
    #[cfg(feature = "log-rtt")]
    // Interrupts are off, so that lines of different tasks do not mix.
    cortex_m::interrupt::free(|_| {
        let mut message = rtt::Message::begin();
        message.put(line.clone());
        message.end();
    });
    #[cfg(feature = "log-uart")]
    uart::write(line.clone());
    let _ = line;
}

/// Logs the program-control command in a received frame, if there is one. (A segment of a block
/// transfer can look like a command.)
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

/// Logs the abort code or the emergency in a sent frame.
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

/// Logs the result of a program's last block or command (1F57h), when it changes.
pub fn status(device: &mut impl Objects, programs: u8) {
    /// The program and the status of the last line.
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
        // A status of 0 is logged only if the last line was about this program.
        if now != before && (word != [0; 4] || before >> 16 == u32::from(sub)) {
            SAID.store(now, Ordering::Relaxed);
            log!("1F57h; program and status", now);
        }
    }
}
