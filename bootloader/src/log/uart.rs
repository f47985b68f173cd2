//! Text over the board's UART, 8N1. A ring in RAM holds the bytes to send, and the UART's interrupt
//! sends them one by one. A line is left out if the ring has no room for it: the bootloader never
//! waits for the UART.

use bsp::ring::Ring;
use bsp::uart::{on_interrupt, Port};
use bsp::UartController;
use cortex_m::interrupt;

/// Holds some 90 ms of text at 115 200 bit/s.
static RING: Ring<1024> = Ring::new();

/// Takes the UART and enables its interrupt.
pub fn open(port: Port<UartController>) {
    let Port { .. } = port;
    on_interrupt(send);
}

/// The port that `open` took. It is used either with interrupts off or from its own interrupt,
/// which cannot be interrupted by another user of the port.
fn port() -> Port<UartController> {
    // SAFETY: as above, there is one user at a time.
    unsafe { Port::steal() }
}

/// Writes a line, if there is room for all of it.
pub fn write(line: impl Iterator<Item = u8> + Clone) {
    // Interrupts are off, so that lines of different tasks do not mix.
    interrupt::free(|_| {
        if line.clone().count() <= RING.room() {
            for byte in line {
                RING.put(byte);
            }
            port().call_for_more();
        }
    });
}

/// The UART's interrupt: the UART has room for a byte.
fn send() {
    let mut port = port();
    if port.has_room() {
        match RING.take() {
            Some(byte) => port.send(byte),
            None => port.stop_calling(),
        }
    }
}
