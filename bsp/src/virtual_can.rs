//! CAN over the board's UART, instead of bxCAN (feature `virtual-can`): the device contains its own
//! SLCAN adapter, on the two wires of the UART. A program uses it like
//! [`can::Port`](crate::can::Port).

use cortex_m::peripheral::NVIC;
use embedded_can::{Frame, Id};
use stm32f4xx_hal::pac::Interrupt;

use crate::can::{Errors, Lost, Mode};
use crate::clock::Source;
use crate::facts::UartController;
use crate::identity::serial_number;
use crate::ring::{Inbox, Ring};
use crate::slcan::{self, Slcan, END, FRAME_TEXT};
use crate::uart::{self, Received};

/// Bytes from the host that wait: room for nine frames, so that a task may take some time.
static RECEIVED: Inbox<256> = Inbox::new();
/// Bytes to the host.
static TO_SEND: Ring<512> = Ring::new();
/// The room that answers leave for frames: a host with endless commands cannot silence the device.
const FOR_FRAMES: usize = 4 * FRAME_TEXT;
/// The most identifiers that are received, as many as in four filter banks of bxCAN. A program
/// always sets the same number of them; no frame has the others.
const IDENTIFIERS: usize = 16;

/// The UART, and the adapter on it.
pub struct Port {
    uart: uart::Port<UartController>,
    slcan: Slcan,
    accepted: [u16; IDENTIFIERS],
    lost: Lost,
    /// Whether a good frame came since the previous call.
    heard: bool,
}

impl Port {
    /// Takes the UART. No frame is received before [`accept`](Self::accept).
    pub fn new(uart: uart::Port<UartController>, _clock: Source) -> Self {
        let mut port = Self {
            uart,
            slcan: Slcan::new(serial_number() as u16),
            accepted: [u16::MAX; IDENTIFIERS],
            lost: Lost::default(),
            heard: false,
        };
        uart::on_interrupt(serve);
        port.uart.call_for_bytes();
        port
    }

    /// A serial line has no bit timing.
    pub fn clock(&self) -> Source {
        Source::Crystal
    }

    /// Does nothing: a serial line has no bit timing, and no other node that a silent one could
    /// disturb.
    pub fn configure(&mut self, _timing: u32, _mode: Mode) {}

    /// A serial line has no bus-off.
    pub fn recover_from_bus_off(&mut self) {}

    /// Sets the identifiers (data frames, 11 bits) that are received.
    pub fn accept<const N: usize>(&mut self, identifiers: [u16; N]) {
        const { assert!(N <= IDENTIFIERS, "virtual CAN: more identifiers than it has room for") };
        self.accepted[..N].copy_from_slice(&identifiers);
    }

    /// The next frame for this device, `None` if there is none.
    pub fn receive<F: Frame>(&mut self) -> Option<F> {
        while let Some(byte) = RECEIVED.take() {
            let Some((answer, frame)) = self.slcan.receive::<F>(byte) else { continue };
            let text = answer.text();
            // A host that does not read gets no further answers.
            if TO_SEND.room() >= FOR_FRAMES + text.len() {
                self.send_text(text.iter().copied());
            }
            let frame = frame.inspect(|_| self.heard = true);
            let accepted = frame.filter(|frame| match frame.id() {
                Id::Standard(id) if !frame.is_remote_frame() => self.accepted.contains(&id.as_raw()),
                _ => false,
            });
            if accepted.is_some() {
                return accepted;
            }
        }
        None
    }

    /// Records that the receiver of frames had no room for one.
    pub fn record_overrun(&mut self) {
        self.lost.in_queue = true;
    }

    /// Whether there is room for a frame.
    pub fn has_room(&mut self) -> bool {
        TO_SEND.room() >= FRAME_TEXT
    }

    /// Sends a frame. Call it only when there is room; otherwise parts of it would be lost. While
    /// the host has closed the channel, the frame is dropped.
    pub fn send<F: Frame>(&mut self, frame: &F) {
        if self.slcan.is_heard() {
            slcan::text_of(frame, |byte| {
                TO_SEND.put(byte);
            });
            self.uart.call_for_more();
        }
    }

    fn send_text(&mut self, text: impl Iterator<Item = u8>) {
        for byte in text {
            TO_SEND.put(byte);
        }
        self.uart.call_for_more();
    }

    /// Whether all frames are on the line.
    pub fn is_idle(&mut self) -> bool {
        TO_SEND.is_empty() && self.uart.is_silent()
    }

    /// The error state of the line: it has no errors of its own.
    pub fn errors(&mut self) -> Errors {
        let last = core::mem::take(&mut self.heard).then_some(Ok(()));
        Errors { off: false, passive: false, joined: true, last }
    }

    /// The places where frames or bytes were lost since the previous call.
    pub fn take_overruns(&mut self) -> Lost {
        Lost { in_controller: RECEIVED.take_overruns(), ..core::mem::take(&mut self.lost) }
    }
}

/// The UART's interrupt: it takes the received byte and sends the next one. It has a higher
/// priority than all tasks, and notifies them through the interrupts of the controller that it
/// replaces.
fn serve() {
    // SAFETY: of the registers that this function uses, the port changes only the control register,
    // and it does so while this interrupt is masked.
    let mut uart = unsafe { uart::Port::<UartController>::steal() };
    if let Some(Received { byte, overrun }) = uart.receive() {
        RECEIVED.come(byte, overrun);
        if byte == Some(END) || RECEIVED.is_pressing() {
            NVIC::pend(Interrupt::CAN1_RX0);
        }
    }
    if uart.has_room() {
        match TO_SEND.take() {
            Some(byte) => uart.send(byte),
            None => {
                uart.stop_calling();
                // There is room again, and a task may wait for the end of all sending.
                NVIC::pend(Interrupt::CAN1_TX);
            }
        }
    }
}
