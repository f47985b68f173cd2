//! A program that never answers: it is not released for autostart, and if it was released by force,
//! it is caught in its rescue window. The built firmware, in virtual time.

use std::time::Duration;

use canopen::NodeId;
use coboot_can::Adapter;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::fleet::Eventful;
use coflash_core::device::error::TrialFailure;
use coflash_core::device::{Session, Timing};
use coflash_core::update::{
    catch, flash, CatchOptions, Caught, DeviceAfterUpdate, DeviceAnswer, DeviceState, FlashOptions,
};
use coflash_core::Error;

/// The time without power at the beginning, while the host already sends requests.
const DARK: Duration = Duration::from_millis(2345);

fn fails(bench: &mut Bench, options: &FlashOptions) -> (Error, DeviceAfterUpdate) {
    let mut left = None;
    let error = flash(&mut bench.session(), firmware::endless_loop().1, options, &mut |event| {
        if let Some(state) = event.left() {
            left = Some(state);
        }
    });
    (error.unwrap_err(), left.expect("how it was left"))
}

/// Switches the board off, starts the requests, and switches the board on.
fn caught(bench: &mut Bench, options: CatchOptions) -> Caught {
    bench.power_off();
    bench.run_ms(100);
    let on = bench.now() + DARK;
    let mut is_on = false;
    let mut happens = |bench: &mut Bench| {
        if !is_on && bench.now() >= on {
            is_on = true;
            bench.power_on();
        }
    };
    let mut bus = Eventful { bench, happens: &mut happens };
    let mut session = Session::new(&mut bus, NodeId::new(NODE).unwrap(), Timing::default());
    catch(&mut session, &options.within(Some(DARK * 2)), &mut |_| {}).unwrap()
}

#[test]
fn a_mute_program_is_not_released_and_the_device_comes_back() {
    let mut bench = Bench::new().switched_on();
    let (error, left) = fails(&mut bench, &FlashOptions::default());
    assert!(matches!(error, Error::TrialFailed { how: TrialFailure::Silent(_), .. }), "{error}");
    assert!(error.to_string().contains("not released for autostart"), "{error}");
    assert_eq!((left.state, left.answer), (DeviceState::Unreleased, DeviceAnswer::Silent));
    assert!(bench.session().device_type().unwrap().is_none(), "it runs, and says nothing");
    let caught = caught(&mut bench, CatchOptions::default());
    assert!(caught.running.is_some_and(|running| running.is_bootloader()), "{caught:?}");
    // The next update needs nothing else.
    bench.update(firmware::APP_V1);
    assert!(!bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

#[test]
fn a_mute_program_that_was_released_by_force_is_caught_in_its_rescue_window() {
    for options in [CatchOptions::default(), CatchOptions::default().any(true)] {
        let mut bench = Bench::new().switched_on();
        let (error, left) = fails(&mut bench, &FlashOptions::default().trial_run(false));
        assert!(matches!(error, Error::StartFailed { running: None, .. }), "{error}");
        assert_eq!((left.state, left.answer), (DeviceState::Released, DeviceAnswer::Silent));
        // It starts by itself: after a power-on nothing answers. The first start is delayed by the
        // frames that the host's controller still has to send, because no node has acknowledged
        // them.
        for _ in 0..2 {
            bench.power_cycle();
            bench.run_ms(1000);
        }
        assert!(bench.session().device_type().unwrap().is_none(), "the program runs");
        let caught = caught(&mut bench, options);
        assert_eq!(caught.node.map(NodeId::get), Some(NODE));
        // It stays, also after a long time without requests.
        bench.run_ms(5000);
        assert!(bench.is_bootloader(NODE));
        bench.assert_nothing_unmodelled();
    }
}
