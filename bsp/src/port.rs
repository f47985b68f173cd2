//! The port for frames, and that both ports are CAN drivers.

use canopen::{BitRate, Frame};

use crate::can::{Errors, Lost, Mode};
use crate::can_driver::CanDriver;

/// The port for frames: the CAN controller, or the UART instead of it.
#[cfg(all(target_arch = "arm", not(feature = "virtual-can")))]
pub type CanPort = crate::can::Port<crate::facts::CanController>;
/// The port for frames: the CAN controller, or the UART instead of it.
#[cfg(all(target_arch = "arm", feature = "virtual-can"))]
pub type CanPort = crate::virtual_can::Port;

/// Both ports have the functions of the trait as their own: firmware knows its port by its type.
macro_rules! is_a_can_driver {
    ($($of:tt)*) => {
        $($of)* {
            fn set_bit_rate(&mut self, rate: BitRate, mode: Mode) {
                if let Some(timing) = crate::line::timing(rate, self.clock()) {
                    self.configure(timing, mode);
                }
            }

            #[inline(always)]
            fn recover_from_bus_off(&mut self) {
                self.recover_from_bus_off();
            }

            #[inline(always)]
            fn accept<const N: usize>(&mut self, identifiers: [u16; N]) {
                self.accept(identifiers);
            }

            #[inline(always)]
            fn receive(&mut self) -> Option<Frame> {
                self.receive()
            }

            #[inline(always)]
            fn record_overrun(&mut self) {
                self.record_overrun();
            }

            #[inline(always)]
            fn has_room(&mut self) -> bool {
                self.has_room()
            }

            #[inline(always)]
            fn send(&mut self, frame: &Frame) {
                self.send(frame);
            }

            #[inline(always)]
            fn is_idle(&mut self) -> bool {
                self.is_idle()
            }

            #[inline(always)]
            fn errors(&mut self) -> Errors {
                self.errors()
            }

            #[inline(always)]
            fn take_overruns(&mut self) -> Lost {
                self.take_overruns()
            }
        }
    };
}

is_a_can_driver!(impl<I: crate::can::Controller> CanDriver for crate::can::Port<I>);
#[cfg(all(target_arch = "arm", feature = "virtual-can"))]
is_a_can_driver!(impl CanDriver for crate::virtual_can::Port);
