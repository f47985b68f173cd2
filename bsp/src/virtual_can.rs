//! CAN over the board's UART, in the place of bxCAN (feature `virtual-can`): the device and, on the
//! same two wires, an SLCAN adapter of its own. What a program does with it is what it does with
//! [`can::Port`](crate::can::Port).

use cortex_m::peripheral::NVIC;
use embedded_can::{Frame, Id};
use stm32f4xx_hal::pac::Interrupt;

use crate::can::{BitTiming, Errors, Lost, Mode};
use crate::ring::{Inbox, Ring};
use crate::slcan::{self, Slcan, END, FRAME_TEXT};
use crate::uart::{self, Received};
use crate::UartController;

/// Bytes from the host that wait: nine frames, so that a task may take a while.
static RECEIVED: Inbox<256> = Inbox::new();
/// Bytes to the host.
static TO_SEND: Ring<512> = Ring::new();
/// What answers leave free for frames: a host that asks and asks cannot silence the device.
const FOR_FRAMES: usize = 4 * FRAME_TEXT;

/// The UART, and the adapter on it.
pub struct Port {
    uart: uart::Port<UartController>,
    slcan: Slcan,
    accepted: Option<[u16; 3]>,
    lost: Lost,
    /// A good frame came since the question before.
    heard: bool,
}

impl Port {
    /// Takes the UART. No frame is taken from it before [`accept`](Self::accept).
    pub fn new(uart: uart::Port<UartController>) -> Self {
        let mut port = Self {
            uart,
            slcan: Slcan::new(crate::serial_number() as u16),
            accepted: None,
            lost: Lost::default(),
            heard: false,
        };
        uart::on_interrupt(serve);
        port.uart.call_for_bytes();
        port
    }

    /// A serial line has no bit timing, and nobody on it that a silent one would not disturb.
    pub fn configure(&mut self, _timing: BitTiming, _mode: Mode) {}

    /// A serial line has no bus-off.
    pub fn recover_from_bus_off(&mut self) {}

    /// Sets the identifiers (data frames, 11 bits) that are taken.
    pub fn accept(&mut self, identifiers: [u16; 3]) {
        self.accepted = Some(identifiers);
    }

    /// The next frame that is for this device, `None` when there is none.
    pub fn receive<F: Frame>(&mut self) -> Option<F> {
        while let Some(byte) = RECEIVED.take() {
            let Some((answer, frame)) = self.slcan.hear::<F>(byte) else { continue };
            let text = answer.text();
            // A host that does not read has no use for more.
            if TO_SEND.room() >= FOR_FRAMES + text.len() {
                self.say(text.iter().copied());
            }
            let frame = frame.inspect(|_| self.heard = true);
            let accepted = frame.filter(|frame| match frame.id() {
                Id::Standard(id) if !frame.is_remote_frame() => {
                    self.accepted.is_some_and(|accepted| accepted.contains(&id.as_raw()))
                }
                _ => false,
            });
            if accepted.is_some() {
                return accepted;
            }
        }
        None
    }

    /// A frame that was taken found no room with its taker.
    pub fn record_overrun(&mut self) {
        self.lost.in_queue = true;
    }

    /// Whether there is room for a frame.
    pub fn has_room(&mut self) -> bool {
        TO_SEND.room() >= FRAME_TEXT
    }

    /// Sends a frame. To be called only when there is room; parts of it would be lost. While the
    /// host has closed the channel there is nobody to send it to.
    pub fn send<F: Frame>(&mut self, frame: &F) {
        if self.slcan.is_heard() {
            slcan::text_of(frame, |byte| {
                TO_SEND.put(byte);
            });
            self.uart.call_for_more();
        }
    }

    fn say(&mut self, text: impl Iterator<Item = u8>) {
        for byte in text {
            TO_SEND.put(byte);
        }
        self.uart.call_for_more();
    }

    /// Whether everything given to it is on the line.
    pub fn is_idle(&mut self) -> bool {
        TO_SEND.is_empty() && self.uart.is_silent()
    }

    /// In place of the errors of a controller.
    pub fn errors(&mut self) -> Errors {
        let last = core::mem::take(&mut self.heard).then_some(Ok(()));
        Errors { off: false, passive: false, joined: true, last }
    }

    /// Where something was lost since the question before.
    pub fn take_overruns(&mut self) -> Lost {
        Lost { in_controller: RECEIVED.take_overruns(), ..core::mem::take(&mut self.lost) }
    }
}

/// The UART's interrupt: takes the byte that has come, sends the next one. It comes before all
/// tasks, and tells them by the interrupts of the controller in whose place it is.
fn serve() {
    // SAFETY: of the registers that it touches, the port changes the control register alone, and
    // does so while this cannot come.
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
                // There is room again, and perhaps somebody who waits for silence.
                NVIC::pend(Interrupt::CAN1_TX);
            }
        }
    }
}
