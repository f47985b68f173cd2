//! Bus-off, error passive, lost frames; and the detection of the bit rate.

use canopen::bit_rate::{BitRate, Detector, Heard};
use canopen::line::{
    Confinement, Consequence, LineEvent, Losses, Monitor, CONTROLLER_OVERRUN, QUEUE_OVERRUN,
};
use kit::bus::at;

use Confinement::{Active, BusOff, Passive};

/// The times at which a controller that never recovers is asked to recover.
fn told_to_come_back(monitor: &mut Monitor, from: u32, until: u32) -> Vec<u32> {
    (from..until)
        .filter(|now| monitor.observe(BusOff, at(*now)) == Some(Consequence::RecoverFromBusOff))
        .collect()
}

#[test]
fn each_return_takes_twice_as_long_up_to_five_seconds() {
    let mut monitor = Monitor::new(at(0));
    let reported = told_to_come_back(&mut monitor, 0, 20_000);
    assert_eq!(reported, [200, 600, 1400, 3000, 6200, 11_200, 16_200]);
}

#[test]
fn a_return_is_told_and_one_that_lasts_restores_patience() {
    let mut monitor = Monitor::new(at(0));
    assert_eq!(told_to_come_back(&mut monitor, 0, 1000), [200, 600]);
    assert_eq!(monitor.observe(Active, at(1000)), Some(Consequence::Tell(LineEvent::Recovered)));
    assert_eq!(monitor.observe(Active, at(1001)), None);
    // Bus-off again at once: the wait keeps growing.
    assert_eq!(told_to_come_back(&mut monitor, 2000, 3000), [2800]);
    assert_eq!(monitor.observe(Active, at(3000)), Some(Consequence::Tell(LineEvent::Recovered)));
    // After ten seconds the wait is the first one again.
    assert_eq!(told_to_come_back(&mut monitor, 13_000, 13_300), [13_200]);
}

#[test]
fn error_passive_is_told_when_it_begins_and_when_it_ends() {
    let mut monitor = Monitor::new(at(0));
    let reported: Vec<_> = [Active, Passive, Passive, Active, Active]
        .iter()
        .map(|state| monitor.observe(*state, at(1)))
        .collect();
    let tell = |event| Some(Consequence::Tell(event));
    assert_eq!(reported, [None, tell(LineEvent::Passive), None, tell(LineEvent::Active), None]);
}

#[test]
fn a_controller_that_left_bus_off_untold_is_believed_only_once_told() {
    let mut monitor = Monitor::new(at(0));
    assert_eq!(monitor.observe(BusOff, at(0)), None);
    assert_eq!(monitor.observe(Passive, at(100)), None);
    assert_eq!(monitor.observe(Passive, at(200)), Some(Consequence::RecoverFromBusOff));
    assert_eq!(monitor.observe(Passive, at(202)), Some(Consequence::Tell(LineEvent::Recovered)));
}

#[test]
fn losses_are_told_at_once_and_then_once_a_second() {
    let mut losses = Losses::default();
    assert_eq!(losses.observe(0, at(0)), None);
    assert_eq!(losses.observe(CONTROLLER_OVERRUN, at(5)), Some(0x0020));
    assert_eq!(losses.observe(CONTROLLER_OVERRUN, at(6)), None);
    assert_eq!(losses.observe(QUEUE_OVERRUN, at(7)), None);
    assert_eq!(losses.observe(0, at(1004)), None);
    assert_eq!(losses.observe(0, at(1005)), Some(0x1020));
    assert_eq!(losses.observe(0, at(9000)), None);
}

/// All bit rates but 800 kbit/s, as with 42 MHz.
fn supports(rate: BitRate) -> bool {
    rate != BitRate::K800
}

#[test]
fn a_good_frame_proves_a_rate_and_an_error_disproves_it() {
    let mut detector = Detector::new(BitRate::K1000, at(0), supports);
    assert_eq!(detector.rate(), BitRate::K1000);
    assert!(!detector.heard(Heard::Nothing, at(10), supports));
    assert_eq!(detector.rate(), BitRate::K1000);
    assert!(!detector.heard(Heard::Error, at(11), supports));
    assert_eq!(detector.rate(), BitRate::K500, "800 kbit/s is none of the device's");
    assert!(detector.heard(Heard::Frame, at(12), supports));
    assert_eq!(detector.rate(), BitRate::K500);
}

#[test]
fn goes_round_all_rates_and_starts_over() {
    let mut detector = Detector::new(BitRate::K125, at(0), supports);
    let mut tried = Vec::new();
    for now in 0..9 {
        tried.push(detector.rate().bits_per_second().unwrap() / 1000);
        detector.heard(Heard::Error, at(now), supports);
    }
    assert_eq!(tried, [125, 100, 50, 20, 10, 1000, 500, 250, 125]);
}

#[test]
fn silence_and_a_bus_that_is_never_idle_end_a_turn() {
    let mut detector = Detector::new(BitRate::K125, at(0), supports);
    assert!(!detector.heard(Heard::Nothing, at(1499), supports));
    assert_eq!(detector.rate(), BitRate::K125);
    assert!(!detector.heard(Heard::Nothing, at(1500), supports));
    assert_eq!(detector.rate(), BitRate::K100);
    assert!(!detector.heard(Heard::NeverIdle, at(1549), supports));
    assert_eq!(detector.rate(), BitRate::K100);
    assert!(!detector.heard(Heard::NeverIdle, at(1550), supports));
    assert_eq!(detector.rate(), BitRate::K50);
}

#[test]
fn a_device_that_supports_nothing_does_not_hang() {
    let mut detector = Detector::new(BitRate::Auto, at(0), |_| false);
    assert!(!detector.heard(Heard::Error, at(1), |_| false));
}
