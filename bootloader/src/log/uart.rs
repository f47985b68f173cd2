//! Text over the board's UART, 8N1. A ring in RAM holds what waits to be sent, byte by byte from the UART's interrupt; a line that
//! finds no room in it is left out: nobody waits for a UART.

use core::sync::atomic::{AtomicU32, AtomicU8, Ordering};

use bsp::uart::{Controller, Port};
use bsp::UartController;
use cortex_m::interrupt;
use cortex_m::peripheral::NVIC;

use crate::ram_vectors;

/// Bytes of the ring: some 90 ms of them at 115 200 bit/s.
const SIZE: u32 = 1024;
static RING: [AtomicU8; SIZE as usize] = [const { AtomicU8::new(0) }; SIZE as usize];
/// Where the next byte goes.
static WRITTEN: AtomicU32 = AtomicU32::new(0);
/// Where the next one is that goes out.
static SENT: AtomicU32 = AtomicU32::new(0);

/// Takes the UART, and begins to send.
pub fn open(port: Port<UartController>) {
    let Port { .. } = port;
    let interrupt = UartController::INTERRUPT;
    ram_vectors::handle(interrupt, send);
    // SAFETY: its handler is there, and works with `port` and the ring alone, as `write` does with interrupts off.
    unsafe { NVIC::unmask(interrupt) };
}

/// The port that `open` took. It is used with interrupts off, or from its own interrupt, which no other one disturbs.
fn port() -> Port<UartController> {
    // SAFETY: as above, one user at a time.
    unsafe { Port::steal() }
}

/// Writes a line, if there is room for all of it.
pub fn write(line: impl Iterator<Item = u8>) {
    interrupt::free(|_| {
        let mut at = WRITTEN.load(Ordering::Relaxed);
        for byte in line {
            let next = (at + 1) % SIZE;
            // A full ring would look like an empty one.
            if next == SENT.load(Ordering::Relaxed) {
                return;
            }
            RING[(at % SIZE) as usize].store(byte, Ordering::Relaxed);
            at = next;
        }
        WRITTEN.store(at, Ordering::Relaxed);
        port().call_for_more(true);
    });
}

/// The UART's interrupt: it has room for a byte.
extern "C" fn send() {
    let mut port = port();
    let at = SENT.load(Ordering::Relaxed);
    if at == WRITTEN.load(Ordering::Relaxed) {
        port.call_for_more(false);
    } else if port.has_room() {
        port.send(RING[(at % SIZE) as usize].load(Ordering::Relaxed));
        SENT.store((at + 1) % SIZE, Ordering::Relaxed);
    }
}
