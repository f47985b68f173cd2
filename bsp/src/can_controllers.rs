//! The two bxCAN controllers of the chip. CAN1 is the master: it has the filters of both, and
//! manages the frame memory of both. So it needs its clock even if only CAN2 is used (RM0090
//! sections 32.3.3 and 32.7.4).

use bxcan::RegisterBlock;
use cortex_m::peripheral::NVIC;
use stm32f4xx_hal::can::Can;
use stm32f4xx_hal::pac::{self, Interrupt};
use stm32f4xx_hal::rcc::{Enable, Rcc, Reset};

use crate::can::Controller;

const CAN1: *mut RegisterBlock = pac::CAN1::PTR as *mut RegisterBlock;

// SAFETY: CAN1 is the master.
unsafe impl Controller for Can<pac::CAN1> {
    const MASTER: *mut RegisterBlock = CAN1;
    const IS_SLAVE: bool = false;
}

// SAFETY: its master is CAN1, and `Take` enables the clock of CAN1.
unsafe impl Controller for Can<pac::CAN2> {
    const MASTER: *mut RegisterBlock = CAN1;
    const IS_SLAVE: bool = true;
}

/// A controller that a board takes in exchange for CAN1, which exists once.
pub trait Take {
    /// Takes it.
    fn take(can1: pac::CAN1, rcc: &mut Rcc) -> Self;
}

impl Take for pac::CAN1 {
    fn take(can1: pac::CAN1, _: &mut Rcc) -> Self {
        can1
    }
}

impl Take for pac::CAN2 {
    /// CAN1 gets its clock and is reset, and only serves CAN2.
    ///
    /// The interrupts of CAN2 are on from here. Each gets the priority of CAN1's, and its handler
    /// calls the handler of CAN1's (`can_controller!`). Call this where CAN1's interrupts already
    /// have their priorities and no interrupt can come: in the `init` of a program.
    fn take(_can1: pac::CAN1, rcc: &mut Rcc) -> Self {
        pac::CAN1::enable(rcc);
        pac::CAN1::reset(rcc);
        // SAFETY: no other code sets the priorities of these interrupts, and no code relies on their
        // being masked.
        unsafe {
            let mut nvic = cortex_m::Peripherals::steal().NVIC;
            for (own, task) in
                [(Interrupt::CAN2_TX, Interrupt::CAN1_TX), (Interrupt::CAN2_RX0, Interrupt::CAN1_RX0)]
            {
                nvic.set_priority(own, NVIC::get_priority(task));
                NVIC::unmask(own);
            }
        }
        // SAFETY: the caller gives up the only CAN1, so it calls this once.
        unsafe { pac::CAN2::steal() }
    }
}
