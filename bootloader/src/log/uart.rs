//! Text over the board's UART, 8N1. A ring in RAM holds what waits to be sent, byte by byte from
//! the UART's interrupt; a line that finds no room in it is left out: nobody waits for a UART.

use bsp::ring::Ring;
use bsp::uart::{on_interrupt, Port};
use bsp::UartController;
use cortex_m::interrupt;

/// Some 90 ms of text at 115 200 bit/s.
static RING: Ring<1024> = Ring::new();

/// Takes the UART, and begins to send.
pub fn open(port: Port<UartController>) {
    let Port { .. } = port;
    on_interrupt(send);
}

/// The port that `open` took. It is used with interrupts off, or from its own interrupt, which no
/// other one disturbs.
fn port() -> Port<UartController> {
    // SAFETY: as above, one user at a time.
    unsafe { Port::steal() }
}

/// Writes a line, if there is room for all of it.
pub fn write(line: impl Iterator<Item = u8> + Clone) {
    // One line behind the other, whoever writes.
    interrupt::free(|_| {
        if line.clone().count() <= RING.room() {
            for byte in line {
                RING.put(byte);
            }
            port().call_for_more();
        }
    });
}

/// The UART's interrupt: it has room for a byte.
fn send() {
    let mut port = port();
    if port.has_room() {
        match RING.take() {
            Some(byte) => port.send(byte),
            None => port.stop_calling(),
        }
    }
}
