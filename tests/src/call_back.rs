//! The return to the bootloader, requested over the bus, at each bit rate of the board.

use bsp::can::BitTiming;
use canopen::program::ProgramControl;
use canopen::BitRate;
use emulator::machine::{ResetCause, Stop};
use emulator::time::Span;

use crate::bench::{Bench, NODE, RESPONSE};

/// The bit rates of CiA 301.
const RATES: [BitRate; 8] = {
    use BitRate::*;
    [K10, K20, K50, K125, K250, K500, K800, K1000]
};

/// The required time between the answer and the reset (SYS TEC manual L-1112d_10, 4.5).
const PAUSE: Span = Span::from_millis(10);

/// At each bit rate of the board: installs the program, calls the bootloader by 1F51h, and checks
/// that the answer is completely on the bus, and 10 ms more have passed, when the chip is reset.
/// `then` continues with the board after its bootloader has answered.
///
/// # Panics
/// If the board does not do this.
pub fn at_every_bit_rate(image: &str, mut then: impl FnMut(BitRate, Bench)) {
    let can_run = |rate: &BitRate| {
        rate.bits_per_second().is_some_and(|bits| BitTiming::new(bsp::CAN_CLOCK, bits).is_some())
    };
    for rate in RATES.into_iter().filter(can_run) {
        let mut bench = Bench::running(rate, image);
        let from = bench.time();
        bench.session().command(1, ProgramControl::StartBootloader).expect("it is answered");
        bench.await_boot_up(2000);
        let events = bench.events();
        let [(reset, Stop::Reset(ResetCause::Software))] = events[..] else { panic!("{rate:?}: {events:?}") };
        let answers = bench.frames_of(RESPONSE, from);
        let (at, data) = answers.iter().rfind(|(at, _)| *at < reset).expect("an answer before the reset");
        assert_eq!(data[..], [0x60, 0x51, 0x1F, 0x01, 0, 0, 0, 0], "{rate:?}");
        assert!(reset - *at >= PAUSE, "{rate:?}: {} us", (reset - *at).0 / 1_000_000);
        assert!(bench.is_bootloader(NODE), "{rate:?}");
        then(rate, bench);
    }
}
