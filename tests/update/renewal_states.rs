//! `coflash` renews a bootloader from whatever state an earlier renewal has left the device in.

use canopen::program::{ProgramControl, PROGRAM_DATA};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::renewal::{
    confirm, crc_of, identification, number, plain, progress, running, stage, start, version,
};
use coflash_core::device::Doing;
use coflash_core::update::{flash, FlashOptions, Renewal};
use coflash_core::Error;
use shared_abi::ram_image::Version;
use shared_abi::renewal::{Origin, State};

const FIRST: u32 = 0x0009_0001;
const SECOND: u32 = 0x0009_0002;

/// A board without a program, in its bootloader.
fn board() -> Bench {
    Bench::new().switched_on()
}

fn renewed(bench: &mut Bench, to: u32) -> Result<Renewal, Error> {
    let new = plain(&version(firmware::BOOTLOADER, to));
    let report = flash(&mut bench.session(), new, &FlashOptions::default(), &mut |_| {});
    report.map(|report| report.renewal.unwrap())
}

/// Two renewals without a restart between them: the first image still runs from staging.
#[test]
fn a_second_renewal_follows_the_first_at_once() {
    let mut bench = board();
    assert_eq!(renewed(&mut bench, FIRST).unwrap().to, Version(FIRST));
    let Renewal { unchanged, from, .. } = renewed(&mut bench, FIRST).unwrap();
    assert_eq!((unchanged, from), (true, Version(FIRST)));
    let Renewal { unchanged, from, to, .. } = renewed(&mut bench, SECOND).unwrap();
    assert_eq!((unchanged, from, to), (false, Version(FIRST), Version(SECOND)));
    assert!(bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

/// A trial that somebody has left open: the same image is confirmed, another one is given up first.
#[test]
fn an_open_trial_is_confirmed_or_given_up() {
    for to in [FIRST, SECOND] {
        let mut bench = board();
        stage(&mut bench, &version(firmware::BOOTLOADER, FIRST));
        start(&mut bench);
        assert_eq!(progress(&mut bench).origin, Origin::Trial);
        assert_eq!(renewed(&mut bench, to).unwrap().to, Version(to));
        assert_eq!((running(&mut bench), progress(&mut bench).state), (to, State::Installed));
    }
}

/// An image was staged, and another download over it was broken off: nothing has become of either.
#[test]
fn what_was_staged_and_lost_is_not_taken_for_what_runs() {
    let mut bench = board();
    let first = version(firmware::BOOTLOADER, FIRST);
    stage(&mut bench, &first);
    let at = Address::new(PROGRAM_DATA, number());
    bench.session().command(number(), ProgramControl::Clear).unwrap();
    let mut broken = version(firmware::BOOTLOADER, SECOND);
    broken[2000] ^= 1;
    let _ = bench.session().write(at, &broken, Doing::Write(at), &mut |_| {});
    bench.session().await_idle(number(), Doing::Write(at)).unwrap();
    assert_eq!(progress(&mut bench).state, State::None);
    println!("1F56h/n reads {:08X}h, staged was {:08X}h", identification(&mut bench), crc_of(&first));
    assert!(!renewed(&mut bench, FIRST).unwrap().unchanged);
    assert_eq!(running(&mut bench), FIRST);
}

/// The steps of a tool that knows nothing of this one.
#[test]
fn a_renewal_by_hand_is_known() {
    let mut bench = board();
    stage(&mut bench, &version(firmware::BOOTLOADER, FIRST));
    start(&mut bench);
    confirm(&mut bench);
    assert!(renewed(&mut bench, FIRST).unwrap().unchanged);
}
