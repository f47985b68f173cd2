//! The two bxCAN controllers of the chip. CAN1 is the master: it has the filters of both, and manages
//! the memory that both keep frames in, so it needs its clock where only CAN2 is used (RM0090
//! sections 32.3.3 and 32.7.4).

use bxcan::RegisterBlock;
use cortex_m::peripheral::NVIC;
use stm32f4xx_hal::can::Can;
use stm32f4xx_hal::pac::{self, Interrupt};
use stm32f4xx_hal::rcc::{Enable, Rcc, Reset};

use crate::can::Controller;

const CAN1: *mut RegisterBlock = pac::CAN1::PTR as *mut RegisterBlock;

// SAFETY: it is the master.
unsafe impl Controller for Can<pac::CAN1> {
    const MASTER: *mut RegisterBlock = CAN1;
    const IS_SLAVE: bool = false;
}

// SAFETY: its master is CAN1, and has a clock: `take_can2` sees to that.
unsafe impl Controller for Can<pac::CAN2> {
    const MASTER: *mut RegisterBlock = CAN1;
    const IS_SLAVE: bool = true;
}

/// CAN2, in exchange for its master: CAN1 gets a clock and is reset, and does nothing but serve.
///
/// The interrupts of CAN2 are on from here, each with the priority of CAN1's, whose handler it calls
/// (`can_controller!`). To be called where those have their priorities already and none can come:
/// in the `init` of a program.
pub fn take_can2(_can1: pac::CAN1, rcc: &mut Rcc) -> pac::CAN2 {
    pac::CAN1::enable(rcc);
    pac::CAN1::reset(rcc);
    // SAFETY: nobody else sets the priorities of these; nothing waits for them to be masked.
    unsafe {
        let mut nvic = cortex_m::Peripherals::steal().NVIC;
        for (own, task) in
            [(Interrupt::CAN2_TX, Interrupt::CAN1_TX), (Interrupt::CAN2_RX0, Interrupt::CAN1_RX0)]
        {
            nvic.set_priority(own, NVIC::get_priority(task));
            NVIC::unmask(own);
        }
    }
    // SAFETY: whoever has the only CAN1 asks once.
    unsafe { pac::CAN2::steal() }
}
